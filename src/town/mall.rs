//! A mall: rows of equal shop fronts, which differ in their names.

use super::dice::Dice;
use super::geometry::{Vec3, vec3};
use super::layout::{
    Building, FRONT, Fixture, Frontage, GroundFloor, KERB, Lot, PAVEMENT_HEIGHT, PLACE_SPACING,
    STREET_END, STREET_START, Street, Taste, Terrace, backdrop,
};
use super::styles::{Brand, brand};

/// Width of a shop front: two to a place, so that each place looks the same.
const SHOP_WIDTH: f32 = PLACE_SPACING / 2.0;

impl Street {
    /// A row of equal shop fronts on both sides, which differ in their names. `building` draws what all streets of the mall
    /// share, and `names` the names in this one.
    pub(super) fn with_shops(mut self, building: &Dice, mut names: Dice) -> Street {
        let mut shared = building.fork(1);
        let mut taste = Taste::new(&mut shared);
        taste.shops = 1.0;
        let mut plan = Terrace::new(&taste, &mut shared);
        (plan.setback, plan.bays, plan.width) = (0.0, 3, SHOP_WIDTH);
        let shops = ((STREET_END - STREET_START) / SHOP_WIDTH).ceil() as usize;
        for side in [1.0, -1.0] {
            for shop in 0..shops {
                let start = STREET_START + shop as f32 * SHOP_WIDTH;
                let at = Frontage::beside(side, start, SHOP_WIDTH, FRONT);
                self.lots.push(Lot::Built(Building {
                    ground: GroundFloor::Shop(&MALL[names.below(MALL.len())]),
                    // The same panes, curtains and lamps in each.
                    colour: plan.colour,
                    mirrored: false,
                    seed: 0,
                    ..plan.house(at, &taste, &mut shared)
                }));
            }
        }
        self.backdrop = backdrop(&taste, &mut shared);
        self.fixtures = lamps();
        self
    }
}

/// Lamps at equal distances, two to a place.
fn lamps() -> Vec<(Fixture, Vec3)> {
    let count = ((STREET_END - STREET_START) / SHOP_WIDTH) as usize;
    let lamp = |at: usize| {
        let side = if at.is_multiple_of(2) { 1.0 } else { -1.0 };
        let x = STREET_START + at as f32 * SHOP_WIDTH;
        (Fixture::Lamp, vec3(x, side * (KERB + 0.45), PAVEMENT_HEIGHT))
    };
    (0..count).map(lamp).collect()
}

/// Names of the shops of a mall, in capitals because the font has no others.
const MALL_NAMES: [&str; 80] = [
    "AURORA",
    "BRAMBLE",
    "CINDER",
    "DELPHI",
    "EMBERLY",
    "FALCON",
    "GARNET",
    "HOLLOW",
    "INDIGO",
    "JUNIPER",
    "KESTREL",
    "LANTERN",
    "MARLOW",
    "NIMBUS",
    "OSPREY",
    "PALMER",
    "RIVET",
    "SABLE",
    "TAMARIN",
    "UMBRIA",
    "VESPER",
    "WILLOW",
    "YARROW",
    "ZEPHYR",
    "BIRCHWOOD",
    "COPPER KEY",
    "DRIFTWOOD",
    "ELM HOUSE",
    "FOXGLOVE",
    "GOLDFINCH",
    "HAZELNUT",
    "IRONSIDE",
    "JASPER",
    "KINGFISHER",
    "LARKSPUR",
    "MOONRAKER",
    "NORTHWIND",
    "OAKHEART",
    "PEPPERMINT",
    "REDWOOD",
    "SANDPIPER",
    "THIMBLE",
    "URBAN NEST",
    "VELVET",
    "WATERMILL",
    "YELLOWTAIL",
    "ARCADIA",
    "BLUEBELL",
    "CLOVERLEAF",
    "DOVETAIL",
    "EVERGREEN",
    "FIREFLY",
    "GINGERBREAD",
    "HONEYCOMB",
    "ISLANDER",
    "JACARANDA",
    "KALEIDO",
    "LEMONADE",
    "MULBERRY",
    "NUTCRACKER",
    "ORCHARD",
    "PINEAPPLE",
    "RASPBERRY",
    "SNOWDROP",
    "TURTLE",
    "VIOLETTA",
    "WHITECAP",
    "BEESWAX",
    "CHESTNUT",
    "DANDELION",
    "MODE 21",
    "STUDIO 54",
    "CLUB 77",
    "DEPOT 9",
    "BLUE DOOR",
    "RED FOX",
    "TALL TREE",
    "GRANITE",
    "PARASOL",
    "CITY BANK",
];

/// The shops of a mall, which has one kind of sign board.
static MALL: [Brand; MALL_NAMES.len()] = mall();

const fn mall() -> [Brand; MALL_NAMES.len()] {
    let mut shops = [const { brand("", 0x2a2f35, 0xf2efe6, None) }; MALL_NAMES.len()];
    let mut at = 0;
    while at < shops.len() {
        shops[at].name = MALL_NAMES[at];
        at += 1;
    }
    shops
}
