//! Conjugate gradients on the tangent, preconditioned by a multigrid cycle on the stiffness at
//! rest.
//!
//! The levels are nested, each fitted to the regions; Chebyshev polynomials smooth (Adams, Brezina,
//! Hu and Tuminaro 2003, doi:10.1016/S0021-9991(03)00194-3). All in single precision: Newton's
//! method corrects what that loses.

use crate::numerics::random::Random;
use crate::synth::elastic::coarse::Coarse;
use crate::synth::elastic::hexahedra::HexMesh;
use crate::synth::elastic::material::{Lame, state};
use crate::synth::elastic::space::Space;
use crate::synth::elastic::tangent::Stiffness;
use crate::synth::elastic::transfer::Transfer;
use crate::synth::elastic::vectors::{Nodal, add, dot, scale_add, scale_add_product};

/// Degree of the Chebyshev smoothing polynomial.
const SMOOTHER_DEGREE: usize = 5;
/// Smallest eigenvalue that it damps, over the largest.
const SMOOTHED_SPECTRUM_RATIO: f32 = 0.06;

/// One level of the cycle.
struct Level<'a> {
    stiffness: Stiffness<'a>,
    inverse_diagonal: Nodal,
    /// From the next coarser level to this one.
    transfer: &'a Transfer,
    free: Nodal,
    largest: f32,
}

/// The cycle over all levels up to one.
pub(crate) struct Multigrid<'a> {
    coarse: Coarse,
    levels: Vec<Level<'a>>,
}

impl<'a> Multigrid<'a> {
    /// The coarsest level: the vertices of `mesh`.
    pub fn new(mesh: &HexMesh, lame: &[Lame]) -> Self {
        Self { coarse: Coarse::new(mesh, lame), levels: Vec::new() }
    }

    /// Adds the next finer level.
    pub fn push(&mut self, space: &'a Space, transfer: &'a Transfer, lame: &[Lame]) {
        let n = space.nodes.len();
        let stiffness = Stiffness::new(
            space,
            state(space, lame, &vec![[0.0; 3]; n], &vec![[0.0; 4]; space.elements.len()]).batches,
        );
        let inverse_diagonal = stiffness.diagonal().into_iter().map(|d| d.map(f32::recip)).collect();
        self.levels.push(Level { stiffness, inverse_diagonal, transfer, free: Vec::new(), largest: 0.0 });
    }

    /// Sets which components are free (1) and which held (0) on the finest level; nodes of a
    /// coarser one come first.
    pub fn hold(&mut self, free: &[[f32; 3]]) {
        self.coarse.hold(free);
        for level in &mut self.levels {
            level.free = free[..level.inverse_diagonal.len()].to_vec();
            if level.largest == 0.0 {
                level.largest = 1.1 * level.largest_eigenvalue();
            }
        }
    }

    /// Solves `k x = b` to `tolerance` times |b|; x and the number of iterations.
    pub fn solve(&self, k: &Stiffness<'_>, b: &[[f32; 3]], tolerance: f64, most: usize) -> (Nodal, usize) {
        let n = b.len();
        let free = &self.levels[self.levels.len() - 1].free;
        let mut x: Nodal = vec![[0.0; 3]; n];
        let mut r = b.to_vec();
        let mut kp: Nodal = vec![[0.0; 3]; n];
        let start = dot(&r, &r);
        let mut z = self.cycle(self.levels.len(), &r);
        let mut p = z.clone();
        let mut rz = dot(&r, &z);
        for iteration in 0..most {
            if dot(&r, &r) <= tolerance * tolerance * start || rz <= 0.0 {
                return (x, iteration);
            }
            k.apply(&p, free, &mut kp);
            let curvature = dot(&p, &kp);
            if curvature <= 0.0 {
                return (if iteration == 0 { p } else { x }, iteration);
            }
            let step = (rz / curvature) as f32;
            add(&mut x, step, &p);
            add(&mut r, -step, &kp);
            z = self.cycle(self.levels.len(), &r);
            let next = dot(&r, &z);
            scale_add(&mut p, (next / rz) as f32, &z);
            rz = next;
        }
        (x, most)
    }

    /// One V-cycle on the lowest `levels` levels.
    fn cycle(&self, levels: usize, r: &[[f32; 3]]) -> Nodal {
        let Some(level) = levels.checked_sub(1).map(|n| &self.levels[n]) else {
            return self.coarse.solve(r);
        };
        let n = r.len();
        let mut x: Nodal = vec![[0.0; 3]; n];
        let mut left = r.to_vec();
        level.smooth(&mut x, &mut left, true);
        let mut work: Nodal = vec![[0.0; 3]; n];
        let mut gathered = level.transfer.gather(&left);
        mask(&mut gathered, &level.free);
        let below = self.cycle(levels - 1, &gathered);
        level.transfer.refine(&below, &mut work);
        mask(&mut work, &level.free);
        add(&mut x, 1.0, &work);
        let mut change: Nodal = vec![[0.0; 3]; n];
        level.stiffness.apply(&work, &level.free, &mut change);
        add(&mut left, -1.0, &change);
        level.smooth(&mut x, &mut left, false);
        x
    }
}

/// Sets what is not free to zero.
fn mask(x: &mut [[f32; 3]], free: &[[f32; 3]]) {
    x.iter_mut().zip(free).for_each(|(x, f)| (0..3).for_each(|c| x[c] *= f[c]));
}

impl Level<'_> {
    /// Adds a Chebyshev polynomial of the residual `left` to x; `left` stays the residual if
    /// `keep`.
    fn smooth(&self, x: &mut [[f32; 3]], left: &mut [[f32; 3]], keep: bool) {
        let (high, low) = (self.largest, SMOOTHED_SPECTRUM_RATIO * self.largest);
        let (middle, half) = ((high + low) / 2.0, (high - low) / 2.0);
        let sigma = middle / half;
        let mut rho = sigma.recip();
        let n = x.len();
        let (mut d, mut kd): (Nodal, Nodal) = (vec![[0.0; 3]; n], vec![[0.0; 3]; n]);
        scale_add_product(&mut d, 0.0, middle.recip(), &self.inverse_diagonal, left);
        for step in 0..SMOOTHER_DEGREE {
            if step > 0 {
                let next = (2.0 * sigma - rho).recip();
                scale_add_product(&mut d, next * rho, 2.0 * next / half, &self.inverse_diagonal, left);
                rho = next;
            }
            add(x, 1.0, &d);
            if step + 1 == SMOOTHER_DEGREE && !keep {
                return;
            }
            self.stiffness.apply(&d, &self.free, &mut kd);
            add(left, -1.0, &kd);
        }
    }

    /// Of the stiffness scaled by its diagonal, by power iteration.
    fn largest_eigenvalue(&self) -> f32 {
        let mut random = Random::new(1, 0);
        let mut x: Nodal =
            self.free.iter().map(|f| std::array::from_fn(|c| f[c] * random.uniform(-1.0, 1.0) as f32)).collect();
        let mut kx = x.clone();
        let mut found = 1.0;
        for _ in 0..12 {
            let length = dot(&x, &x).sqrt() as f32;
            x.iter_mut().for_each(|v| *v = v.map(|v| v / length.max(f32::MIN_POSITIVE)));
            self.stiffness.apply(&x, &self.free, &mut kx);
            let previous = x.clone();
            scale_add_product(&mut x, 0.0, 1.0, &self.inverse_diagonal, &kx);
            found = dot(&x, &x).sqrt().max(dot(&x, &previous)) as f32;
        }
        found
    }
}
