//! One prior, or one denoiser, for each stage of the schedule.

use crate::{BoxError, Call, Denoiser, Estimate, Prior, PriorError};
use ndarray::{ArrayView3, ArrayView4, ArrayViewMut4};

/// One part for each stage of the schedule, so that a cheap one can prepare the ground for a dear one: `PerStage<dyn Prior>` is a
/// [`Prior`], `PerStage<dyn Denoiser>` a [`Denoiser`], for [`TwoStage`](crate::TwoStage).
pub struct PerStage<T: ?Sized> {
    parts: Vec<Box<T>>,
    of_stage: Vec<usize>,
}

impl<T: ?Sized> PerStage<T> {
    /// Stage `s` calls `parts[of_stage[s]]`.
    ///
    /// # Panics
    /// If an index is out of range.
    pub fn new(parts: Vec<Box<T>>, of_stage: Vec<usize>) -> Self {
        assert!(of_stage.iter().all(|&i| i < parts.len()), "every stage names a part");
        Self { parts, of_stage }
    }

    fn of(&mut self, stage: usize) -> Result<&mut T, BoxError> {
        match self.of_stage.get(stage) {
            Some(&index) => Ok(&mut self.parts[index]),
            None => Err(format!("stage {stage} has no prior: there are {}", self.of_stage.len()).into()),
        }
    }
}

impl Prior for PerStage<dyn Prior + '_> {
    fn apply(&mut self, call: &Call<'_>, noisy: ArrayView3<'_, f32>, out: &mut Estimate) -> Result<(), PriorError> {
        let of_stage = self.of(call.stage);
        let prior = of_stage.map_err(|source| PriorError { part: "prior", name: "of each stage".into(), source })?;
        prior.apply(call, noisy, out)
    }
}

impl Denoiser for PerStage<dyn Denoiser + '_> {
    fn name(&self) -> &str {
        self.parts.first().map_or("none", |part| part.name())
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        self.of(call.stage)?.denoise(call, noisy, out)
    }
}
