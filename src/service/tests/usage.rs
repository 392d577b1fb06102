use jiff::{SignedDuration, Timestamp};

use super::Fixture;
use whereabouts_api::ErrorKind;
use whereabouts_core::{DayUsage, Usage, utc_day};
use whereabouts_store::UsageStore;

async fn spend(fixture: &Fixture, days_ago: i64, map: &str, calls: u32, money: f64) {
    let date = utc_day(Timestamp::now()).saturating_sub(SignedDuration::from_hours(24 * days_ago));
    let usage = Usage { calls, prompt_tokens: u64::from(calls) * 10, ..Usage::default() };
    let day = DayUsage { date, map: map.parse().unwrap(), usage, money };
    fixture.store.add_usage(day).await.unwrap();
}

#[tokio::test]
async fn a_report_sums_the_days_and_maps_that_it_covers() {
    let fixture = Fixture::new().await;
    spend(&fixture, 0, "yard", 1, 0.25).await;
    spend(&fixture, 0, "yard", 2, 0.25).await;
    spend(&fixture, 1, "hall", 4, 1.0).await;
    spend(&fixture, 7, "yard", 8, 2.0).await;
    let usage = &fixture.service.usage;

    let week = usage.report(None, 7).await.unwrap();
    assert_eq!((week.total.usage.calls, week.total.usage.prompt_tokens), (7, 70));
    assert_eq!(week.total.money, 1.5);
    let maps: Vec<_> = week.days.iter().map(|day| day.map.as_str()).collect();
    assert_eq!(maps, ["yard", "hall"], "newest first, one row for each day and map");

    let yard = usage.report(Some("yard".parse().unwrap()), 8).await.unwrap();
    assert_eq!((yard.total.usage.calls, yard.days.len()), (11, 2));
    let today = usage.report(None, 1).await.unwrap();
    assert_eq!(today.total.usage.calls, 3);
    assert!(today.today.is_none(), "the refiner calls no paid model");
}

#[tokio::test]
async fn a_report_covers_at_least_a_day_and_at_most_the_retention() {
    let fixture = Fixture::new().await;
    let usage = &fixture.service.usage;
    for days in [0, 31] {
        let refused = usage.report(None, days).await.unwrap_err();
        assert_eq!(refused.kind, ErrorKind::Unprocessable);
        assert!(refused.detail.contains("1 to 30"), "{refused}");
    }
    assert_eq!(usage.report(None, 30).await.unwrap().days, []);
}
