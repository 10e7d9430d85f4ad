//! A sequence of volumes: the displacement from one of them to each other, frame by frame.
//!
//! Every frame is measured against the reference itself, so that errors do not add up; the search starts from where the
//! tissue was in the frame before and where steady motion would take it, beside the starts that a pair of volumes has.

use crate::error::FieldError;
use crate::pipeline::field::{FieldResult, Progress, Start, run_from};
use crate::types::{FieldParams, Mask, Volume};

/// Follows the tissue of one volume through others that were taken one after the other.
#[derive(Debug, Clone)]
pub struct Tracker<'a> {
    reference: &'a Volume,
    mask: Option<&'a Mask>,
    params: &'a FieldParams,
    /// Of the frame before, and of the one before that.
    past: [Option<Start>; 2],
}

impl<'a> Tracker<'a> {
    /// `mask` lies on the reference's grid.
    pub fn new(reference: &'a Volume, mask: Option<&'a Mask>, params: &'a FieldParams) -> Self {
        Self { reference, mask, params, past: [None, None] }
    }

    /// Forgets the frames so far: the next one again comes right after (or before) the reference.
    pub fn restart(&mut self) {
        self.past = [None, None];
    }

    /// Measures the displacement from the reference to the next frame.
    ///
    /// # Errors
    /// As [`crate::pipeline::field::run`]; the tracker then goes on from the frames before.
    pub fn next(&mut self, frame: &Volume, progress: Progress<'_>) -> Result<FieldResult, FieldError> {
        let [last, before] = &self.past;
        let steady = last.as_ref().zip(before.as_ref()).and_then(|(l, b)| l.extrapolated(b));
        let starts: Vec<Start> = last.iter().cloned().chain(steady).collect();
        let result = run_from(self.reference, frame, self.mask, self.params, &starts, progress)?;
        self.past.swap(0, 1);
        self.past[0] = Some(result.spline.clone());
        Ok(result)
    }
}
