//! Usage: spend by day and map.

use futures_util::future::join_all;
use jiff::civil::{Date, date};
use whereabouts_core::{DayUsage, Usage};
use whereabouts_store::Store;

use crate::support::Fixture;

contract!(spend_adds_up_by_day_and_map, spend_before_a_day_is_forgotten,);

fn spent(date: Date, map: &str, calls: u32, money: f64) -> DayUsage {
    let usage = Usage {
        calls,
        cached: 2 * calls,
        prompt_tokens: u64::from(calls) << 33,
        completion_tokens: 3,
        estimated: 1,
    };
    DayUsage { date, map: map.parse().unwrap(), usage, money }
}

async fn spend_adds_up_by_day_and_map(fixture: &Fixture) {
    let store = fixture.open().await;
    let (first, second) = (date(2026, 2, 28), date(2026, 3, 1));
    assert!(store.usage(first).await.unwrap().is_empty());
    store.add_usage(spent(second, "b", 1, 0.25)).await.unwrap();
    store.add_usage(spent(first, "z", 1, 0.1)).await.unwrap();
    let adding = (0..8).map(|_| store.add_usage(spent(second, "a-b", 2, 0.5)));
    join_all(adding).await.into_iter().for_each(Result::unwrap);
    store.add_usage(spent(second, "a.b", 1, 0.0)).await.unwrap();
    let all = async |store: &dyn Store, from| -> Vec<_> {
        let days = store.usage(from).await.unwrap();
        days.into_iter()
            .map(|day| (day.date, String::from(day.map), day.usage, day.money))
            .collect()
    };
    let one = spent(second, "m", 1, 0.0).usage;
    let eight = Usage {
        calls: 16,
        cached: 32,
        prompt_tokens: 16 << 33,
        completion_tokens: 24,
        estimated: 8,
    };
    let expected = [
        (first, "z".to_owned(), one, 0.1),
        (second, "a-b".to_owned(), eight, 4.0),
        (second, "a.b".to_owned(), one, 0.0),
        (second, "b".to_owned(), one, 0.25),
    ];
    assert_eq!(all(&*store, first).await, expected);
    assert_eq!(all(&*store, second).await, expected[1..]);
    drop(store);
    let store = fixture.open().await;
    assert_eq!(all(&*store, first).await, expected);
}

async fn spend_before_a_day_is_forgotten(fixture: &Fixture) {
    let store = fixture.open().await;
    for day in [1, 9, 10, 11] {
        store.add_usage(spent(date(2026, 10, day), "m", 1, 1.0)).await.unwrap();
    }
    store.forget_usage(date(2026, 10, 10)).await.unwrap();
    let left = store.usage(date(2000, 1, 1)).await.unwrap();
    assert_eq!(left.iter().map(|day| day.date.day()).collect::<Vec<_>>(), [10, 11]);
}
