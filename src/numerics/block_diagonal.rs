//! A symmetric 3 x 3 matrix for each node of a lattice.

/// One symmetric 3 x 3 matrix a node, stored by entry: all xx, then all yy, zz, xy, xz and yz.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Blocks(Vec<f32>);

impl Blocks {
    /// From all xx, all yy, zz, xy, xz and yz, one after the other: a multiple of six values.
    pub(crate) fn from_planar(values: Vec<f32>) -> Self {
        assert!(values.len().is_multiple_of(6), "{} values are no six a node", values.len());
        Self(values)
    }

    /// Nodes.
    pub fn len(&self) -> usize {
        self.0.len() / 6
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Of node `i`: xx, yy, zz, xy, xz, yz.
    #[inline(always)]
    pub fn at(&self, i: usize) -> [f32; 6] {
        let n = self.len();
        std::array::from_fn(|q| self.0[q * n + i])
    }

    /// Node by node.
    pub fn iter(&self) -> impl Iterator<Item = [f32; 6]> {
        (0..self.len()).map(|i| self.at(i))
    }

    /// All xx, all yy and so on.
    pub fn planar(&self) -> &[f32] {
        &self.0
    }

    /// All xx, all yy and so on, to be changed.
    pub(crate) fn planar_mut(&mut self) -> &mut [f32] {
        &mut self.0
    }
}

impl From<&[[f32; 6]]> for Blocks {
    /// From one matrix a node.
    fn from(nodes: &[[f32; 6]]) -> Self {
        let mut values = vec![0.0; 6 * nodes.len()];
        for (q, values) in values.chunks_exact_mut(nodes.len().max(1)).enumerate() {
            values.iter_mut().zip(nodes).for_each(|(v, node)| *v = node[q]);
        }
        Self(values)
    }
}
