//! A small hash map that pairs the two facets that meet at an edge of a cavity's surface.

/// Open addressing with a time stamp, so that emptying costs nothing.
pub(super) struct EdgeMap {
    slots: Vec<Slot>,
    shift: u32,
    stamp: u32,
}

#[derive(Clone, Copy, Default)]
struct Slot {
    edge: u64,
    value: u32,
    stamp: u32,
}

impl EdgeMap {
    /// An empty map.
    pub(super) fn new() -> Self {
        Self { slots: vec![Slot::default(); 256], shift: 64 - 8, stamp: 0 }
    }

    /// Forgets everything and makes room for `edges` edges at a load of at most a half.
    pub(super) fn start(&mut self, edges: usize) -> Pairs<'_> {
        let wanted = (2 * edges).next_power_of_two();
        if wanted > self.slots.len() || self.stamp == u32::MAX {
            let size = wanted.max(self.slots.len());
            *self = Self { slots: vec![Slot::default(); size], shift: 64 - size.trailing_zeros(), stamp: 0 };
        }
        self.stamp += 1;
        Pairs { slots: &mut self.slots, shift: self.shift, stamp: self.stamp }
    }
}

/// The map while one cavity is filled.
pub(super) struct Pairs<'a> {
    slots: &'a mut [Slot],
    shift: u32,
    stamp: u32,
}

impl Pairs<'_> {
    /// The value stored for the edge between `a` and `b`, or none on its first visit, when `value`
    /// is stored.
    #[inline(always)]
    pub(super) fn pair(&mut self, a: u32, b: u32, value: u32) -> Option<u32> {
        let edge = u64::from(a.min(b)) << 32 | u64::from(a.max(b));
        let mask = self.slots.len() - 1;
        let mut at = (edge.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> self.shift) as usize;
        loop {
            let slot = &mut self.slots[at & mask];
            if slot.stamp != self.stamp {
                *slot = Slot { edge, value, stamp: self.stamp };
                return None;
            }
            if slot.edge == edge {
                return Some(slot.value);
            }
            at += 1;
        }
    }
}
