//! A layered block under a flat punch that sticks: plane strain, small strain, the same laws as the
//! column.
//!
//! Bilinear quadrilaterals with mean dilatation (B-bar; Hughes 1980), so that layers that hardly
//! change their volume do not lock. The stress is `D (e0 e + c0 e' + sum s_i)` with D the
//! elasticity of modulus 1 and the scene's Poisson's ratio, and each component follows the element.
//! Time steps are implicit: Maxwell branches by their exponential with the strain linear within the
//! step (Herrmann & Peterson 1968), the lone dashpot by backward differences of order 2 (of order 1
//! right after a corner of the load); stiff layers do not limit the step. The block is symmetric,
//! so half of it is modelled.

use crate::numerics::banded::Band;
use crate::skin::column::times;
use crate::types::skin::{BlockRun, BlockShape, SkinSample, SkinScene};

/// Cells of the finite element mesh.
struct BlockCells {
    /// Cells along half the width.
    half_width: usize,
    /// Fewest cells along the thickness of a layer.
    min_per_layer: usize,
    /// Approximate number of cells along the thickness of all layers.
    thickness: usize,
}

const BLOCK_CELLS: BlockCells = BlockCells { half_width: 48, min_per_layer: 4, thickness: 16 };

/// Positions of the 2 x 2 Gauss points: 1 / sqrt(3).
const GAUSS_POINTS: [f64; 2] = [-0.577_350_269_189_625_8, 0.577_350_269_189_625_8];

/// Strain xx, yy, zz, xy (engineering shear).
type Strain = [f64; 4];

/// The half block.
struct Mesh {
    /// Node places along x, from the middle of the punch.
    x: Vec<f64>,
    /// Along y, from the base.
    y: Vec<f64>,
    /// Layer of each row of cells, from the base.
    layer: Vec<usize>,
    /// Nodes along x under the punch.
    pressed: usize,
}

impl Mesh {
    fn new(scene: &SkinScene) -> Self {
        let (half, punch) = (scene.block.width / 2.0, scene.block.indenter / 2.0);
        let inner = if punch < half {
            ((BLOCK_CELLS.half_width as f64 * (punch / half).sqrt()) as usize).clamp(8, BLOCK_CELLS.half_width - 8)
        } else {
            BLOCK_CELLS.half_width
        };
        let mut x: Vec<f64> = (0..=inner).map(|i| punch * i as f64 / inner as f64).collect();
        let outer = BLOCK_CELLS.half_width - inner;
        // Growing outwards from the size under the punch.
        let mut steps = Vec::new();
        if outer > 0 {
            let first = punch / inner as f64;
            let span = half - punch;
            let mut ratio: f64 = 1.0;
            let sum = |r: f64| (0..outer).map(|k| first * r.powi(k as i32)).sum::<f64>();
            let (mut low, mut high) = (1e-3f64, 10.0f64);
            for _ in 0..100 {
                ratio = (low * high).sqrt();
                if sum(ratio) < span { low = ratio } else { high = ratio }
            }
            steps = (0..outer).map(|k| first * ratio.powi(k as i32)).collect();
            let scale = span / steps.iter().sum::<f64>();
            steps.iter_mut().for_each(|s| *s *= scale);
        }
        for step in steps {
            x.push(x[x.len() - 1] + step);
        }
        let (mut y, mut layer) = (vec![0.0], Vec::new());
        let all = scene.thickness();
        for (number, l) in scene.layers.iter().enumerate().rev() {
            let cells =
                ((BLOCK_CELLS.thickness as f64 * l.thickness / all).round() as usize).max(BLOCK_CELLS.min_per_layer);
            let base = y[y.len() - 1];
            y.extend((1..=cells).map(|k| base + l.thickness * k as f64 / cells as f64));
            layer.extend(std::iter::repeat_n(number, cells));
        }
        Self { x, y, layer, pressed: inner + 1 }
    }

    fn cells(&self) -> [usize; 2] {
        [self.x.len() - 1, self.y.len() - 1]
    }

    fn node(&self, i: usize, j: usize) -> usize {
        i * self.y.len() + j
    }

    /// Nodes around a cell, and the strain matrices (rows) with the area of its Gauss points.
    fn cell(&self, i: usize, j: usize) -> ([usize; 4], [([[f64; 8]; 4], f64); 4]) {
        let nodes = [self.node(i, j), self.node(i + 1, j), self.node(i + 1, j + 1), self.node(i, j + 1)];
        let (dx, dy) = (self.x[i + 1] - self.x[i], self.y[j + 1] - self.y[j]);
        const CORNERS: [[f64; 2]; 4] = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
        let gradient = |xi: f64, eta: f64| -> [[f64; 2]; 4] {
            CORNERS.map(|[a, b]| [0.25 * a * (1.0 + b * eta) * 2.0 / dx, 0.25 * b * (1.0 + a * xi) * 2.0 / dy])
        };
        let mean = gradient(0.0, 0.0);
        let points = [0, 1, 2, 3].map(|g| {
            let n = gradient(GAUSS_POINTS[g % 2], GAUSS_POINTS[g / 2]);
            let mut b = [[0.0; 8]; 4];
            for k in 0..4 {
                // The dilatation is that of the middle, spread over the three normal strains.
                let swell = [0, 1].map(|a| (mean[k][a] - n[k][a]) / 3.0);
                for a in 0..2 {
                    let at = 2 * k + a;
                    (b[0][at], b[1][at], b[2][at]) = (swell[a], swell[a], swell[a]);
                    b[a][at] += n[k][a];
                    b[3][at] = n[k][1 - a];
                }
            }
            (b, 0.25 * dx * dy)
        });
        (nodes, points)
    }
}

/// Elasticity of modulus 1 in plane strain times a strain.
fn elasticity(poisson: f64, e: &Strain) -> Strain {
    let lambda = poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson));
    let mu = 0.5 / (1.0 + poisson);
    let trace = e[0] + e[1] + e[2];
    [lambda * trace + 2.0 * mu * e[0], lambda * trace + 2.0 * mu * e[1], lambda * trace + 2.0 * mu * e[2], mu * e[3]]
}

/// What a Gauss point remembers.
#[derive(Clone)]
struct Memory {
    strain: Strain,
    /// The strain a step earlier.
    before: Strain,
    /// Stress of each branch, before D.
    branches: Vec<Strain>,
}

/// A layer's law over one step: `sigma = D (modulus e + history)`.
struct StepLaw {
    modulus: f64,
    /// Factors of the last two strains in the lone dashpot's stress.
    lone: [f64; 2],
    /// Decay and modulus of each branch.
    branches: Vec<[f64; 2]>,
}

impl StepLaw {
    /// `h` is this step (s), `last` the one before in the same phase.
    fn new(e0: f64, c0: f64, branches: &[[f64; 2]], h: f64, last: Option<f64>) -> Self {
        let branches: Vec<[f64; 2]> = branches
            .iter()
            .map(|[modulus, dashpot]| {
                let z = h * modulus / dashpot;
                let share = if z > 1e-8 { -(-z).exp_m1() / z } else { 1.0 - z / 2.0 };
                [(-z).exp(), share * modulus]
            })
            .collect();
        let rate = match last.map(|last| h / last) {
            Some(w) => [(1.0 + 2.0 * w) / (1.0 + w), -(1.0 + w), w * w / (1.0 + w)],
            None => [1.0, -1.0, 0.0],
        };
        let [now, lone @ ..] = rate.map(|r| c0 * r / h);
        Self { modulus: e0 + now + branches.iter().map(|b| b[1]).sum::<f64>(), lone, branches }
    }

    fn history(&self, memory: &Memory) -> Strain {
        std::array::from_fn(|c| {
            let branches = self.branches.iter().zip(&memory.branches);
            let kept: f64 = branches.map(|(b, s)| b[0] * s[c] - b[1] * memory.strain[c]).sum();
            kept + self.lone[0] * memory.strain[c] + self.lone[1] * memory.before[c]
        })
    }

    fn advance(&self, memory: &mut Memory, strain: Strain) {
        for (b, s) in self.branches.iter().zip(&mut memory.branches) {
            for c in 0..4 {
                s[c] = b[0] * s[c] + b[1] * (strain[c] - memory.strain[c]);
            }
        }
        memory.before = memory.strain;
        memory.strain = strain;
    }
}

/// The response of the scene's block; none when a step has no solution (values beyond all measure).
/// A scene must have been checked.
pub fn respond(scene: &SkinScene) -> Option<BlockRun> {
    let mesh = Mesh::new(scene);
    let [nx, ny] = mesh.cells();
    let load = &scene.load;
    let unload = load.ramp + load.hold;
    let cells: Vec<_> = (0..nx * ny).map(|n| mesh.cell(n / ny, n % ny)).collect();
    let mut memory: Vec<Memory> = (0..4 * cells.len())
        .map(|at| Memory {
            strain: [0.0; 4],
            before: [0.0; 4],
            branches: vec![[0.0; 4]; scene.layers[mesh.layer[at / 4 % ny]].maxwell.len()],
        })
        .collect();
    let mut run = BlockRun { cells: [nx, ny], layer: mesh.layer.clone(), samples: Vec::new(), shapes: Vec::new() };
    run.samples.push(sample(scene, &mesh, 0.0, &vec![0.0; 2 * mesh.x.len() * mesh.y.len()], 0.0, 0.0));
    let mut before = 0.0;
    let mut impulse = 0.0;
    let phases = times(scene);
    for (phase, times) in phases.iter().enumerate() {
        let pressed = phase < 2;
        let mut step_before = None;
        for &time in times.iter().filter(|t| **t > 0.0) {
            // The corner itself belongs to the phase before.
            let h = time - before;
            if h <= 1e-12 * load.end {
                continue;
            }
            let depth = load.displacement * (time / load.ramp).min(1.0);
            let laws: Vec<StepLaw> = scene
                .layers
                .iter()
                .map(|l| {
                    let (c0, branches) = l.dashpots(!pressed);
                    StepLaw::new(l.e0, c0, &branches, h, step_before)
                })
                .collect();
            let (u, force) = step(scene, &mesh, &cells, &memory, &laws, pressed.then_some(depth))?;
            for (n, (nodes, points)) in cells.iter().enumerate() {
                for (g, (b, _)) in points.iter().enumerate() {
                    laws[mesh.layer[n % ny]].advance(&mut memory[4 * n + g], strain(b, nodes, &u));
                }
            }
            let stress = if pressed { -force / (scene.block.indenter / 2.0) } else { 0.0 };
            impulse += 0.5 * h * (stress + run.samples.last().map_or(0.0, |s| s.stress));
            run.samples.push(sample(scene, &mesh, time, &u, stress, impulse));
            let last = phase == 2 && (time - load.end).abs() < 1e-9 * load.end;
            if last || (time - unload).abs() < 1e-9 * unload {
                run.shapes.push(shape(&mesh, time, &u));
            }
            before = time;
            step_before = Some(h);
        }
    }
    Some(run)
}

/// Displacements after a step, and the punch's force on the half block (N a m).
fn step(
    scene: &SkinScene,
    mesh: &Mesh,
    cells: &[([usize; 4], [([[f64; 8]; 4], f64); 4])],
    memory: &[Memory],
    laws: &[StepLaw],
    depth: Option<f64>,
) -> Option<(Vec<f64>, f64)> {
    let (rows, ny) = (mesh.y.len(), mesh.y.len() - 1);
    let size = 2 * mesh.x.len() * rows;
    let mut band = Band::new(size, 2 * rows + 3);
    let mut rhs = vec![0.0; size];
    let nu = scene.block.poisson;
    for (n, (nodes, points)) in cells.iter().enumerate() {
        let law = &laws[mesh.layer[n % ny]];
        for (g, (b, area)) in points.iter().enumerate() {
            let history = elasticity(nu, &law.history(&memory[4 * n + g]));
            let columns: [Strain; 8] =
                std::array::from_fn(|q| elasticity(nu, &std::array::from_fn(|c| law.modulus * b[c][q])));
            for p in 0..8 {
                let at = 2 * nodes[p / 2] + p % 2;
                rhs[at] -= area * (0..4).map(|c| b[c][p] * history[c]).sum::<f64>();
                for q in 0..8 {
                    let value = (0..4).map(|c| b[c][p] * columns[q][c]).sum::<f64>();
                    band.add(at, 2 * nodes[q / 2] + q % 2, area * value);
                }
            }
        }
    }
    let mut fixed = vec![None; size];
    for i in 0..mesh.x.len() {
        let base = 2 * mesh.node(i, 0);
        (fixed[base], fixed[base + 1]) = (Some(0.0), Some(0.0));
        if let Some(depth) = depth.filter(|_| i < mesh.pressed) {
            let top = 2 * mesh.node(i, ny);
            (fixed[top], fixed[top + 1]) = (Some(0.0), Some(-depth));
        }
    }
    (0..rows).for_each(|j| fixed[2 * mesh.node(0, j)] = Some(0.0));
    band.fix(&mut rhs, &fixed);
    if !band.solve(&mut rhs) {
        return None;
    }
    let u = rhs;
    // The punch's force is what its nodes resist.
    let mut force = 0.0;
    for (n, (nodes, points)) in cells.iter().enumerate().filter(|(n, _)| n % ny == ny - 1 && depth.is_some()) {
        let law = &laws[mesh.layer[n % ny]];
        for (g, (b, area)) in points.iter().enumerate() {
            let (e, h) = (strain(b, nodes, &u), law.history(&memory[4 * n + g]));
            let sigma = elasticity(nu, &std::array::from_fn(|c| law.modulus * e[c] + h[c]));
            for k in [2, 3].into_iter().filter(|&k| nodes[k] / rows < mesh.pressed) {
                force += area * (0..4).map(|c| b[c][2 * k + 1] * sigma[c]).sum::<f64>();
            }
        }
    }
    Some((u, force))
}

fn strain(b: &[[f64; 8]; 4], nodes: &[usize; 4], u: &[f64]) -> Strain {
    std::array::from_fn(|c| (0..8).map(|q| b[c][q] * u[2 * nodes[q / 2] + q % 2]).sum())
}

/// Depth and layer strains in the middle of the punch, and the mean pressure under it.
fn sample(scene: &SkinScene, mesh: &Mesh, time: f64, u: &[f64], stress: f64, impulse: f64) -> SkinSample {
    let down = |j: usize| -u[2 * mesh.node(0, j) + 1];
    let strain = (0..scene.layers.len()).map(|layer| {
        let rows: Vec<usize> = (0..mesh.layer.len()).filter(|&j| mesh.layer[j] == layer).collect();
        let (low, high) = (rows[0], rows[rows.len() - 1] + 1);
        (down(high) - down(low)) / (mesh.y[high] - mesh.y[low])
    });
    SkinSample { time, stress, displacement: down(mesh.y.len() - 1), strain: strain.collect(), impulse }
}

fn shape(mesh: &Mesh, time: f64, u: &[f64]) -> BlockShape {
    let [nx, ny] = mesh.cells();
    let place = |n: usize| {
        let (i, j) = (n / mesh.y.len(), n % mesh.y.len());
        [mesh.x[i] + u[2 * n], mesh.y[j] + u[2 * n + 1]]
    };
    let v = |i: usize, j: usize| u[2 * mesh.node(i, j) + 1];
    let compression = |n: usize| {
        let (i, j) = (n / ny, n % ny);
        0.5 * (v(i, j) + v(i + 1, j) - v(i, j + 1) - v(i + 1, j + 1)) / (mesh.y[j + 1] - mesh.y[j])
    };
    BlockShape {
        time,
        nodes: (0..mesh.x.len() * mesh.y.len()).map(place).collect(),
        compression: (0..nx * ny).map(compression).collect(),
    }
}
