//! The state of one refinement.

use parking_lot::Mutex;
use tokio::sync::OnceCell;
use whereabouts_core::{SimilarFrame, Usage};

use super::budget::JobBudget;
use super::gate::CallPlace;
use super::pictures::SentPicture;
use crate::{Progress, RefineInput};

/// One refinement: its input, what it may spend, and what it has spent so far.
pub(super) struct RefineRun<'a> {
    pub input: &'a RefineInput,
    pub budget: JobBudget,
    pub progress: &'a dyn Progress,
    /// Earlier frames that are nearly the same, whose descriptions may stand in.
    pub similar: Vec<SimilarFrame>,
    /// The frame as it is sent. Prepared on first use, because a refinement whose pairs are all cached
    /// does not need it.
    pub frame: OnceCell<SentPicture>,
    usage: Mutex<Usage>,
}

impl<'a> RefineRun<'a> {
    pub fn new(
        input: &'a RefineInput,
        budget: JobBudget,
        similar: Vec<SimilarFrame>,
        progress: &'a dyn Progress,
    ) -> Self {
        let (frame, usage) = (OnceCell::new(), Mutex::default());
        Self { input, budget, progress, similar, frame, usage }
    }

    /// Returns the place of its calls among those that wait.
    pub fn place(&self) -> CallPlace {
        CallPlace::new(self.input.priority, self.input.id)
    }

    /// Returns what this attempt has spent so far.
    pub fn usage(&self) -> Usage {
        *self.usage.lock()
    }

    /// Adds to what this attempt has spent.
    pub fn charge(&self, cost: Usage) {
        *self.usage.lock() += cost;
    }
}
