//! Errors that a displacement field may have.

use crate::error::SpaceError;
use crate::types::space::{Grid, Matrix3};

/// Errors that a displacement field may have, drawn at random from its posterior distribution:
/// cubic B-splines through their coefficients at nodes.
///
/// Each is as likely as any other; what follows from the field is as uncertain as it varies from
/// one to the next.
#[derive(Debug, Clone, PartialEq)]
pub struct ErrorSamples {
    nodes: Grid,
    values: Vec<Vec<f32>>,
}

impl ErrorSamples {
    /// From the grid of the nodes and each sample's coefficients (mm, RAS, planar).
    ///
    /// # Errors
    /// [`SpaceError::Length`] when a sample does not have three values a node.
    pub fn new(nodes: Grid, values: Vec<Vec<f32>>) -> Result<Self, SpaceError> {
        let expected = 3 * nodes.len();
        match values.iter().map(Vec::len).find(|&found| found != expected) {
            Some(found) => Err(SpaceError::Length { expected, found }),
            None => Ok(Self { nodes, values }),
        }
    }

    /// The same errors after a linear map of the world.
    #[must_use]
    pub fn turned(mut self, linear: &Matrix3) -> Self {
        let n = self.nodes.len();
        for sample in &mut self.values {
            for at in 0..n {
                let v = [0, 1, 2].map(|c| f64::from(sample[c * n + at]));
                (0..3).for_each(|r| sample[r * n + at] = (0..3).map(|c| linear[r][c] * v[c]).sum::<f64>() as f32);
            }
        }
        self
    }

    /// Where the nodes are.
    pub fn nodes(&self) -> &Grid {
        &self.nodes
    }

    /// The coefficients of each sample (mm, RAS, planar).
    pub fn values(&self) -> &[Vec<f32>] {
        &self.values
    }
}
