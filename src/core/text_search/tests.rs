use super::*;
use crate::text_line::lines;

fn score(query: &str, read: &[&str]) -> Option<f32> {
    TextQuery::new(query).unwrap().matches(&lines(read)).map(|found| found.score)
}

#[test]
fn what_readers_and_people_get_wrong_is_found() {
    for (query, read) in [
        ("kawa coffea", &["Kawa Coffee"][..]),
        ("Kawa Coffee", &["KAWACOFFEE"]),
        ("kawa coffee", &["KAWA", "COFFEE"]),
        ("coffee kawa", &["Kawa Coffee"]),
        ("marios", &["MARIO'S"]),
        ("MARIO'S", &["MARIOS"]),
        ("mario\u{2019}s", &["Mario's pizza"]),
        ("BOOK", &["B00K"]),
        ("HOTEL", &["H0TE1"]),
        ("milk", &["MlLK"]),
        ("modern", &["modem"]),
        ("www", &["vvww"]),
        ("SALE 50", &["5ALE SO"]),
        ("Żabka", &["ZABKA"]),
        ("zabka", &["Żabka"]),
        ("Straße", &["STRASSE"]),
        ("CAFÉ", &["cafe\u{301}"]),
        ("İstanbul", &["istanbul"]),
        ("ＡＢＣ ｓｈｏｐ", &["ABC SHOP"]),
        ("東京", &["東京駅"]),
        ("駅", &["東京駅"]),
        ("ｶﾌｪ", &["カフェ"]),
        ("7-Eleven", &["7ELEVEn"]),
        ("pharmcay", &["PHARMACY"]),
        ("express24", &["EXPRESS 24"]),
        ("A7", &["a7"]),
        ("A7", &["A7 Nord"]),
        ("5", &["5 Main Street"]),
        ("bar", &["Snack-Bar"]),
        ("bank", &["BANKHAUS"]),
        ("bamk", &["City Bank"]),
        ("hotel", &["GRAND H0TFL"]),
        ("pharmcay", &["24HPHARMACY"]),
        ("カフエ", &["東京カフェ館"]),
        ("аптека", &["АПТЕКА"]),
        ("서울", &["서울역"]),
    ] {
        assert!(score(query, read).is_some(), "{query:?} in {read:?}");
        let shared = grams(read.iter().copied());
        let asked = TextQuery::grams(query);
        assert!(asked.iter().any(|gram| shared.contains(gram)), "{query:?} {read:?}: no gram");
    }
}

#[test]
fn other_texts_are_not_found() {
    for (query, read) in [
        ("bank", &["BOOKS"][..]),
        ("bar", &["BAKERY"]),
        ("bar", &["BARBER"]),
        ("bank", &["BAKER&SON"]),
        ("tank", &["THANKS"]),
        ("cafe", &["SCARFE"]),
        ("market", &["SUPERMARKEN"]),
        ("Kawa Coffee", &["Pharmacy", "24 h"]),
        ("12", &["1234"]),
        ("5", &["8"]),
        ("45", &["48"]),
        ("東京", &["京都"]),
        ("a", &["KAWA"]),
        ("Starbucks", &["Stars", "bus"]),
    ] {
        assert_eq!(score(query, read), None, "{query:?} in {read:?}");
    }
    assert!(TextQuery::new(" -'!").is_none());
}

#[test]
fn better_matches_rank_higher() {
    let best = score("coffee", &["COFFEE"]).unwrap();
    assert!((best - 1.0).abs() < 1e-6, "{best}");
    let ranked = [
        score("coffee", &["COFFEE"]),
        score("coffee", &["C0FFEE"]),
        score("coffee", &["Kawa Coffee"]),
        score("coffee", &["Kawa Coffea"]),
    ];
    assert!(ranked.windows(2).all(|pair| pair[0] > pair[1]), "{ranked:?}");
}

#[test]
fn the_lines_that_match_are_named() {
    let read = lines(&["Bank", "KAWA", "COFFEE", "open"]);
    let found = TextQuery::new("kawa coffee").unwrap().matches(&read).unwrap();
    assert_eq!(found.lines, [1, 2]);
    let found = TextQuery::new("bank").unwrap().matches(&read).unwrap();
    assert_eq!(found.lines, [0]);
}
