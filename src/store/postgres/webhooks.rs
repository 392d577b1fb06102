//! Webhooks and their deliveries. Other processes skip a delivery that a process is sending, while that
//! process is alive.

use async_trait::async_trait;
use jiff::Timestamp;
use jiff_sqlx::ToSqlx;
use sqlx::types::Json;
use sqlx::{PgConnection, Postgres, Transaction};
use tokio::sync::watch;
use uuid::Uuid;

use super::super::changes::{
    attempted, check_enabled, check_ended, disable, no_delivery, no_webhook, too_many_webhooks,
};
use super::super::{
    DeliveryRetention, RemovedDeliveries, StoreError, StoredDelivery, WebhookStore,
};
use super::listener::DELIVERIES;
use super::statements::advisory_lock;
use super::{Inner, PostgresStore, count, counted, record};
use whereabouts_core::{Attempt, Delivery, DeliveryState, StoredWebhook};

/// The advisory lock of calls that add webhooks.
const WEBHOOKS_LOCK: i64 = 0x7768_6572_6561_0002;

impl Inner {
    pub(super) async fn insert_delivery(
        &self,
        tx: &mut Transaction<'_, Postgres>,
        new: &StoredDelivery,
    ) -> Result<(), StoreError> {
        let StoredDelivery { delivery, body } = new;
        sqlx::query(
            "INSERT INTO deliveries (webhook, id, state, due_at, ended_at, record, body)
             VALUES ($1, $2, $3, $4, $5, $6::json, $7)",
        )
        .bind(delivery.webhook)
        .bind(delivery.id)
        .bind(delivery.state.as_str())
        .bind(delivery.next_attempt_at.map(|at| at.to_sqlx()))
        .bind(delivery.ended_at.map(|at| at.to_sqlx()))
        .bind(record(delivery)?)
        .bind(body.as_slice())
        .execute(&mut **tx)
        .await?;
        Ok(())
    }

    async fn update_delivery(
        &self,
        tx: &mut Transaction<'_, Postgres>,
        delivery: &Delivery,
    ) -> Result<(), StoreError> {
        sqlx::query(
            "UPDATE deliveries SET state = $3, due_at = $4, ended_at = $5, record = $6::json,
                 holder = NULL
             WHERE webhook = $1 AND id = $2",
        )
        .bind(delivery.webhook)
        .bind(delivery.id)
        .bind(delivery.state.as_str())
        .bind(delivery.next_attempt_at.map(|at| at.to_sqlx()))
        .bind(delivery.ended_at.map(|at| at.to_sqlx()))
        .bind(record(delivery)?)
        .execute(&mut **tx)
        .await?;
        Ok(())
    }

    async fn lock_delivery(
        &self,
        tx: &mut Transaction<'_, Postgres>,
        webhook: Uuid,
        id: Uuid,
    ) -> Result<Option<Delivery>, StoreError> {
        let sql = "SELECT record FROM deliveries WHERE webhook = $1 AND id = $2 FOR UPDATE";
        let found: Option<Json<Delivery>> =
            sqlx::query_scalar(sql).bind(webhook).bind(id).fetch_optional(&mut **tx).await?;
        Ok(found.map(|Json(delivery)| delivery))
    }

    async fn notify_deliveries(
        &self,
        tx: &mut Transaction<'_, Postgres>,
    ) -> Result<(), StoreError> {
        sqlx::query("SELECT pg_notify($1, '')").bind(DELIVERIES).execute(&mut **tx).await?;
        Ok(())
    }
}

/// Reads a webhook and locks it against changes until the end of the transaction.
async fn lock_webhook(
    connection: &mut PgConnection,
    id: Uuid,
) -> Result<StoredWebhook, StoreError> {
    let sql = "SELECT record FROM webhooks WHERE id = $1 FOR SHARE";
    let found: Option<Json<StoredWebhook>> =
        sqlx::query_scalar(sql).bind(id).fetch_optional(connection).await?;
    found.map(|Json(stored)| stored).ok_or_else(|| no_webhook(id))
}

#[async_trait]
impl WebhookStore for PostgresStore {
    async fn add_webhook(&self, webhook: StoredWebhook, max: usize) -> Result<(), StoreError> {
        let inner = &self.inner;
        let text = record(&webhook)?;
        inner
            .call(async {
                let mut tx = inner.begin().await?;
                advisory_lock(&mut tx, WEBHOOKS_LOCK).await?;
                let existing: i64 =
                    sqlx::query_scalar("SELECT count(*) FROM webhooks").fetch_one(&mut *tx).await?;
                if counted(existing) >= max {
                    return Err(too_many_webhooks(max));
                }
                let add = sqlx::query("INSERT INTO webhooks (id, record) VALUES ($1, $2::json)");
                add.bind(webhook.webhook.id).bind(&text).execute(&mut *tx).await?;
                Ok(tx.commit().await?)
            })
            .await
    }

    async fn webhooks(&self) -> Result<Vec<StoredWebhook>, StoreError> {
        self.inner.all(sqlx::query_scalar("SELECT record FROM webhooks ORDER BY id")).await
    }

    async fn webhook(&self, id: Uuid) -> Result<Option<StoredWebhook>, StoreError> {
        let query = sqlx::query_scalar("SELECT record FROM webhooks WHERE id = $1");
        self.inner.one(query.bind(id)).await
    }

    async fn disable_webhook(&self, id: Uuid, at: Timestamp, why: &str) -> Result<(), StoreError> {
        let inner = &self.inner;
        inner
            .call(async {
                let mut tx = inner.begin().await?;
                let sql = "SELECT record FROM webhooks WHERE id = $1 FOR UPDATE";
                let found: Option<Json<StoredWebhook>> =
                    sqlx::query_scalar(sql).bind(id).fetch_optional(&mut *tx).await?;
                let Some(Json(mut stored)) = found else { return Ok(()) };
                if disable(&mut stored, at, why) {
                    let change = sqlx::query("UPDATE webhooks SET record = $2::json WHERE id = $1");
                    change.bind(id).bind(record(&stored)?).execute(&mut *tx).await?;
                    tx.commit().await?;
                }
                Ok(())
            })
            .await
    }

    async fn delete_webhook(&self, id: Uuid) -> Result<bool, StoreError> {
        let inner = &self.inner;
        // The foreign key deletes its deliveries as well.
        let query = sqlx::query("DELETE FROM webhooks WHERE id = $1").bind(id);
        Ok(inner.run(query).await? > 0)
    }

    async fn queue_delivery(&self, new: StoredDelivery) -> Result<(), StoreError> {
        let inner = &self.inner;
        inner
            .call(async {
                let mut tx = inner.begin().await?;
                check_enabled(&lock_webhook(&mut tx, new.delivery.webhook).await?)?;
                inner.insert_delivery(&mut tx, &new).await?;
                inner.notify_deliveries(&mut tx).await?;
                Ok(tx.commit().await?)
            })
            .await
    }

    async fn queue_again(
        &self,
        webhook: Uuid,
        id: Uuid,
        now: Timestamp,
    ) -> Result<Delivery, StoreError> {
        let inner = &self.inner;
        inner
            .call(async {
                let mut tx = inner.begin().await?;
                let stored = lock_webhook(&mut tx, webhook).await?;
                let ended = inner.lock_delivery(&mut tx, webhook, id).await?;
                let ended = ended.ok_or_else(|| no_delivery(id))?;
                let checked = check_enabled(&stored).and_then(|()| check_ended(&ended));
                if checked.is_err() {
                    // Unlock at once, because queries for due deliveries skip a locked one.
                    tx.rollback().await?;
                    return checked.map(|()| ended);
                }
                let again = ended.requeued(now);
                inner.update_delivery(&mut tx, &again).await?;
                inner.notify_deliveries(&mut tx).await?;
                tx.commit().await?;
                Ok(again)
            })
            .await
    }

    async fn deliveries(
        &self,
        webhook: Uuid,
        state: Option<DeliveryState>,
        before: Option<Uuid>,
        limit: usize,
    ) -> Result<Vec<Delivery>, StoreError> {
        let query = sqlx::query_scalar(
            "SELECT record FROM deliveries
             WHERE webhook = $1 AND id < $2 AND ($3::text IS NULL OR state = $3)
             ORDER BY id DESC LIMIT $4",
        )
        .bind(webhook)
        .bind(before.unwrap_or(Uuid::max()))
        .bind(state.map(DeliveryState::as_str))
        .bind(count(limit));
        self.inner.all(query).await
    }

    async fn due_deliveries(
        &self,
        webhook: Uuid,
        now: Timestamp,
        limit: usize,
    ) -> Result<Vec<StoredDelivery>, StoreError> {
        let inner = &self.inner;
        let query = sqlx::query_as(
            "WITH due AS (
                 SELECT id FROM deliveries WHERE webhook = $1 AND due_at <= $2
                     AND (holder IS NULL OR holder = $4
                         OR NOT is_alive(holder, make_interval(secs => $5)))
                 ORDER BY due_at, id LIMIT $3 FOR UPDATE SKIP LOCKED)
             UPDATE deliveries d SET holder = $4 FROM due WHERE d.webhook = $1 AND d.id = due.id
             RETURNING d.record, d.body",
        )
        .bind(webhook)
        .bind(now.to_sqlx())
        .bind(count(limit))
        .bind(inner.process)
        .bind(inner.lifetime());
        inner
            .call(async {
                let due: Vec<(Json<Delivery>, Vec<u8>)> = query.fetch_all(&inner.pool).await?;
                let mut due: Vec<StoredDelivery> = due
                    .into_iter()
                    .map(|(Json(delivery), body)| StoredDelivery { delivery, body })
                    .collect();
                due.sort_by_key(|due| (due.delivery.next_attempt_at, due.delivery.id));
                Ok(due)
            })
            .await
    }

    async fn note_attempt(
        &self,
        webhook: Uuid,
        id: Uuid,
        attempt: Attempt,
    ) -> Result<Option<Delivery>, StoreError> {
        let inner = &self.inner;
        inner
            .call(async {
                let mut tx = inner.begin().await?;
                let Some(before) = inner.lock_delivery(&mut tx, webhook, id).await? else {
                    return Ok(None);
                };
                let Some(after) = attempted(before, attempt) else { return Ok(None) };
                inner.update_delivery(&mut tx, &after).await?;
                tx.commit().await?;
                Ok(Some(after))
            })
            .await
    }

    async fn give_up_deliveries(
        &self,
        webhook: Uuid,
        at: Timestamp,
        why: &str,
        limit: usize,
    ) -> Result<usize, StoreError> {
        let inner = &self.inner;
        inner
            .call(async {
                let mut tx = inner.begin().await?;
                let waiting: Vec<Json<Delivery>> = sqlx::query_scalar(
                    "SELECT record FROM deliveries WHERE webhook = $1 AND due_at IS NOT NULL
                     ORDER BY due_at, id LIMIT $2 FOR UPDATE SKIP LOCKED",
                )
                .bind(webhook)
                .bind(count(limit))
                .fetch_all(&mut *tx)
                .await?;
                let given_up = waiting.len();
                for Json(delivery) in waiting {
                    inner.update_delivery(&mut tx, &delivery.dead_lettered(at, why)).await?;
                }
                tx.commit().await?;
                Ok(given_up)
            })
            .await
    }

    async fn forget_deliveries(
        &self,
        keep: DeliveryRetention,
        batch: usize,
    ) -> Result<RemovedDeliveries, StoreError> {
        let inner = &self.inner;
        inner
            .call(async {
                let all: i64 = sqlx::query_scalar("SELECT count(*) FROM deliveries")
                    .fetch_one(&inner.pool)
                    .await?;
                let surplus = (all - count(keep.most)).max(0);
                // Those that ended first, then the oldest waiting ones.
                let (ended, waiting): (i64, i64) = sqlx::query_as(
                    "WITH ended AS (
                         SELECT webhook, id, ended_at, row_number() OVER () AS number
                         FROM (SELECT webhook, id, ended_at FROM deliveries
                               WHERE ended_at IS NOT NULL ORDER BY ended_at, webhook, id LIMIT $3) e),
                     old AS (
                         SELECT webhook, id FROM ended
                         WHERE number <= $2 OR coalesce(ended_at < $1, false)),
                     waiting AS (
                         SELECT webhook, id FROM deliveries WHERE ended_at IS NULL ORDER BY id
                         LIMIT greatest(least($2, $3) - (SELECT count(*) FROM ended), 0)),
                     gone AS (
                         DELETE FROM deliveries d
                         USING (SELECT * FROM old UNION ALL SELECT * FROM waiting) x
                         WHERE d.webhook = x.webhook AND d.id = x.id RETURNING d.ended_at)
                     SELECT count(*) FILTER (WHERE ended_at IS NOT NULL),
                         count(*) FILTER (WHERE ended_at IS NULL) FROM gone",
                )
                .bind(keep.since.map(|since| since.to_sqlx()))
                .bind(surplus)
                .bind(count(batch))
                .fetch_one(&inner.pool)
                .await?;
                Ok(RemovedDeliveries { ended: counted(ended), waiting: counted(waiting) })
            })
            .await
    }

    async fn waiting_deliveries(&self) -> Result<usize, StoreError> {
        let inner = &self.inner;
        inner
            .call(async {
                let waiting = "SELECT count(*) FROM deliveries WHERE due_at IS NOT NULL";
                let waiting: i64 = sqlx::query_scalar(waiting).fetch_one(&inner.pool).await?;
                Ok(counted(waiting))
            })
            .await
    }

    fn queued_deliveries(&self) -> watch::Receiver<()> {
        self.inner.deliveries.subscribe()
    }
}
