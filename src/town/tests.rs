use std::collections::HashMap;

use super::camera::{Camera, Pose};
use super::font;
use super::geometry::{Panel, vec3};
use super::layout::{GroundFloor, Lot, Street};
use super::styles::BRANDS;
use super::{Light, SUCCESS_RADIUS_M, Shot, Town, TownScene, TownSpec};

fn town(seed: u64, places: usize, width: u32, height: u32) -> Town {
    Town::new(TownSpec { seed, places, width, height, ..TownSpec::default() })
}

fn distance(one: &Shot, other: &Shot) -> f64 {
    (one.x - other.x).hypot(one.y - other.y)
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    let (one, other) = (town(3, 9, 96, 72), town(3, 9, 96, 72));
    assert_eq!(one.reference(8).image, other.reference(8).image);
    assert_eq!(one.query(8, 2).image, other.query(8, 2).image);
}

#[test]
fn different_seeds_give_different_towns() {
    let (one, other) = (town(3, 9, 96, 72), town(4, 9, 96, 72));
    assert_ne!(one.reference(0).image, other.reference(0).image);
}

#[test]
fn a_place_does_not_depend_on_how_many_there_are() {
    let (small, large) = (town(3, 2, 64, 48), town(3, 200, 64, 48));
    assert_eq!(small.reference(1).image, large.reference(1).image);
}

#[test]
fn a_query_is_within_the_radius_of_its_own_place_and_of_no_other() {
    let town = town(7, 50, 1, 1);
    let references: Vec<Shot> = (0..town.places()).map(|place| town.reference(place)).collect();
    for place in 0..town.places() {
        for variant in 0..4 {
            let query = town.query(place, variant);
            for reference in &references {
                let near = distance(&query, reference) < SUCCESS_RADIUS_M;
                assert_eq!(near, reference.place == place, "{place} {}", reference.place);
            }
        }
    }
}

#[test]
fn a_query_is_displaced_but_faces_the_same_way() {
    let town = town(7, 24, 1, 1);
    let mut moved = 0.0_f64;
    for place in 0..town.places() {
        let (reference, query) = (town.reference(place), town.query(place, 0));
        let turn = (query.heading - reference.heading + 180.0).rem_euclid(360.0) - 180.0;
        assert!(turn.abs() <= 13.1, "{turn}");
        assert!((0.0..360.0).contains(&query.heading));
        moved = moved.max(distance(&reference, &query));
    }
    assert!((1.0..2.6).contains(&moved), "{moved}");
}

#[test]
fn four_variants_are_taken_in_four_lights() {
    let town = town(7, 3, 1, 1);
    let lights: Vec<Light> = (4..8).map(|variant| town.query(2, variant).light).collect();
    assert!(Light::ALL.iter().all(|light| lights.contains(light)));
    assert_eq!(town.reference(2).light, Light::Day);
}

#[test]
fn any_resolution_works() {
    for (width, height) in [(1, 1), (33, 17), (17, 33), (640, 480), (0, 0)] {
        let shot = town(7, 4, width, height).query(1, 1);
        assert_eq!(shot.image.dimensions(), (width.max(1), height.max(1)));
    }
}

#[test]
fn places_wrap_around() {
    let town = town(7, 5, 16, 12);
    assert_eq!(town.reference(7).place, 2);
    assert_eq!(town.reference(7).image, town.reference(2).image);
    assert_eq!(Town::new(TownSpec { places: 0, ..TownSpec::default() }).places(), 1);
}

#[test]
fn a_point_of_a_facade_projects_as_the_camera_geometry_predicts() {
    let pose = Pose { eye: vec3(0.0, 0.0, 2.0), yaw: 90_f32.to_radians(), pitch: 0.0, roll: 0.0 };
    let camera = Camera::new(&pose, 640, 480);
    let focal = 320.0 / 36_f32.to_radians().tan();
    let facade = Panel::upright(vec3(-4.0, 10.0, 0.0), vec3(6.0, 10.0, 0.0), 8.0);
    // 3 m right of and 4 m above the eye, 10 m away.
    let (x, y, depth) = camera.project(facade.point(7.0, 6.0)).unwrap_or_default();
    assert!((x - (320.0 + focal * 0.3)).abs() < 0.01, "{x}");
    assert!((y - (240.0 - focal * 0.4)).abs() < 0.01, "{y}");
    assert!((depth - 10.0).abs() < 1e-4, "{depth}");
}

#[test]
fn the_view_of_a_slanted_panel_inverts_its_projection() {
    let pose = Pose { eye: vec3(1.0, -2.0, 1.9), yaw: 0.9, pitch: 0.1, roll: 0.02 };
    let camera = Camera::new(&pose, 640, 480);
    let panel = Panel::upright(vec3(0.0, 9.0, 0.1), vec3(12.0, 9.0, 0.1), 9.0);
    let view = camera.view(&panel);
    let seen = view.and_then(|view| {
        let (x, y, depth) = camera.project(panel.point(7.5, 3.25))?;
        let (u, v) = view.uv(x, y);
        Some((u, v, depth * view.inverse_depth.at(x, y)))
    });
    let (u, v, unity) = seen.unwrap_or_default();
    assert!((u - 7.5).abs() < 1e-3, "{u}");
    assert!((v - 3.25).abs() < 1e-3, "{v}");
    assert!((unity - 1.0).abs() < 1e-4, "{unity}");
}

#[test]
fn styles_and_chain_shops_recur_in_many_streets() {
    let mut streets_of: HashMap<&str, usize> = HashMap::new();
    for index in 0..10 {
        let mut names: Vec<&str> = Street::new(TownScene::Streets, 7, index)
            .lots
            .iter()
            .filter_map(|lot| match lot {
                Lot::Built(building) => match building.ground {
                    GroundFloor::Shop(brand) => Some(brand.name),
                    GroundFloor::Home { .. } => None,
                },
                _ => None,
            })
            .collect();
        names.sort_unstable();
        names.dedup();
        for name in names {
            *streets_of.entry(name).or_default() += 1;
        }
    }
    let chains = streets_of.values().filter(|&&streets| streets >= 3).count();
    assert!(chains >= BRANDS.len() / 2, "{streets_of:?}");
}

#[test]
fn every_sign_can_be_written_in_the_font() {
    for brand in &BRANDS {
        for letter in brand.name.split_whitespace().flat_map(|word| word.split("")) {
            let inked = (0..400).any(|dot| {
                let (x, y) = ((dot % 20) as f32 / 20.0, (dot / 20) as f32 / 20.0);
                font::ink(letter, x, y, 0.05) > 0.9
            });
            assert!(inked || letter.is_empty(), "{letter}");
        }
    }
}

#[test]
fn the_shops_of_a_mall_differ_in_their_names_only() {
    let [one, other] = [0, 3].map(|index| Street::new(TownScene::Mall, 7, index));
    let names = |street: &Street| -> Vec<&str> {
        let shop = |lot: &Lot| match lot {
            Lot::Built(building) => match building.ground {
                GroundFloor::Shop(brand) => Some((brand.name, building.floors, building.at.width)),
                GroundFloor::Home { .. } => None,
            },
            _ => None,
        };
        let shops: Vec<_> = street.lots.iter().map(|lot| shop(lot).expect("a shop")).collect();
        assert!(shops.iter().all(|shop| (shop.1, shop.2) == (shops[0].1, shops[0].2)));
        shops.into_iter().map(|shop| shop.0).collect()
    };
    let (one, other) = (names(&one), names(&other));
    assert!(one.len() == other.len() && one != other);
    let names = one.iter().chain(&other);
    assert!(names.clone().all(|name| font::text_width(name) > 0.0));
}

#[test]
fn a_query_in_a_mall_is_near_its_place() {
    let town =
        Town::new(TownSpec { scene: TownScene::Mall, seed: 7, places: 24, width: 1, height: 1 });
    for place in 0..town.places() {
        let (reference, query) = (town.reference(place), town.query(place, 0));
        assert!(distance(&reference, &query) < SUCCESS_RADIUS_M / 2.0 + 0.5);
    }
}

#[test]
fn the_signs_of_a_picture_are_where_its_letters_are() {
    let town = Town::new(TownSpec { scene: TownScene::Mall, places: 8, ..TownSpec::default() });
    let (shot, signs, letters) = town.with_signs(0, Some(0));
    assert_eq!(shot.image, town.query(0, 0).image, "the same picture as without the truth");
    assert_eq!(town.with_signs(0, None).0.image, town.reference(0).image);
    let whole = signs.iter().filter(|sign| sign.is_within(640, 480) && sign.uncovered > 0.9);
    let whole: Vec<_> = whole.collect();
    assert!(whole.len() >= 2, "{signs:?}");
    for sign in whole {
        let below = sign.corners.map(|[x, y]| [x, y + 3.0 * sign.letter_height]);
        assert!(letters.within(&sign.corners) > 20 * letters.within(&below).max(1), "{sign:?}");
        let [top_left, _, _, bottom_left] = sign.corners;
        assert!(top_left[1] < bottom_left[1] && sign.letter_height > 1.0);
    }
    assert!(signs.iter().all(|sign| (0.0..=1.0).contains(&sign.uncovered)));
}

#[test]
fn people_and_furniture_cover_signs() {
    let town = Town::new(TownSpec { scene: TownScene::Mall, places: 16, ..TownSpec::default() });
    let signs = (0..16).flat_map(|place| town.with_signs(place, Some(0)).1);
    let covered = signs.filter(|sign| sign.uncovered < 0.95).count();
    assert!(covered > 0);
}
