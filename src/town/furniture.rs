//! What stands on the pavements of a street with houses.

use super::dice::Dice;
use super::geometry::{Vec3, vec3};
use super::layout::{Fixture, KERB, PAVEMENT_HEIGHT, STREET_END, STREET_START, Tree};

pub(super) fn plant(dice: &mut Dice) -> Vec<Tree> {
    let spacing = dice.between(13.0, 24.0);
    let mut trees = Vec::new();
    for side in [1.0, -1.0] {
        let mut x = STREET_START + dice.between(0.0, spacing);
        while x < STREET_END {
            if dice.chance(0.55) {
                trees.push(Tree {
                    foot: vec3(x, side * (KERB + 0.8), PAVEMENT_HEIGHT),
                    height: dice.between(4.2, 6.6),
                    seed: dice.bits() as u32,
                });
            }
            x += spacing + dice.around(2.5);
        }
    }
    trees
}

pub(super) fn furnish(dice: &mut Dice) -> Vec<(Fixture, Vec3)> {
    const SMALL: [Fixture; 5] =
        [Fixture::RoadSign, Fixture::PostBox, Fixture::Bin, Fixture::Bollard, Fixture::Bench];
    let mut fixtures = Vec::new();
    for side in [1.0, -1.0] {
        let kerbside = |x: f32, inset: f32| vec3(x, side * (KERB + inset), PAVEMENT_HEIGHT);
        let mut x = STREET_START + 6.0 * (1.0 + side);
        while x < STREET_END {
            fixtures.push((Fixture::Lamp, kerbside(x + dice.around(1.5), 0.45)));
            if dice.chance(0.8) {
                let kind = dice.pick(&SMALL);
                fixtures.push((kind, kerbside(x + dice.between(3.0, 18.0), 0.6)));
            }
            x += 24.0;
        }
    }
    fixtures
}
