use std::time::Duration;

use jiff::Timestamp;
use proptest::prelude::*;

use crate::Limits;
use whereabouts_core::{ApiKey, KeyLimits, Role};

fn key(limits: KeyLimits) -> ApiKey {
    ApiKey {
        id: "key".into(),
        name: "key".into(),
        role: Role::Robot,
        maps: vec![],
        limits,
        created_at: Timestamp::now(),
        expires_at: None,
        revoked_at: None,
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn a_key_never_gets_more_than_its_burst_and_rate_and_a_retry_after_is_enough(
        per_minute in 1..200_u32,
        gaps_ms in proptest::collection::vec(0..5000_u64, 1..100),
    ) {
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_time()
            .start_paused(true)
            .build()
            .unwrap();
        runtime.block_on(async {
            let limits = Limits::default();
            let requests_per_minute = Some(per_minute);
            let key = key(KeyLimits { requests_per_minute, bytes_per_minute: None });
            let (mut granted, mut elapsed) = (0.0, Duration::ZERO);
            for gap in gaps_ms.into_iter().map(Duration::from_millis) {
                tokio::time::advance(gap).await;
                elapsed += gap;
                let (allowances, result) = limits.take_request(&key).await;
                let allowance = allowances.requests.unwrap();
                prop_assert!(allowance.remaining < u64::from(per_minute));
                prop_assert!(allowance.reset <= Duration::from_secs(61));
                granted += 1.0;
                if let Err(error) = result {
                    // Rounded up to the clock's milliseconds.
                    let pause = error.retry_after.unwrap() + Duration::from_millis(1);
                    tokio::time::advance(pause).await;
                    elapsed += pause;
                    prop_assert!(limits.take_request(&key).await.1.is_ok(), "after {:?}", pause);
                }
                let available = f64::from(per_minute) * (1.0 + elapsed.as_secs_f64() / 60.0);
                prop_assert!(granted <= available + 0.1, "{} of {}", granted, available);
            }
            Ok(())
        })?;
    }
}
