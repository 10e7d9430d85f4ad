//! Coarse hexahedra fitted to the regions of each phantom.

use crate::synth::elastic::hexahedra::{CURVED, HELD, HexMesh, PRESSED, Surfaces};

/// A ball in a block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ball {
    /// Centre (mm).
    pub centre: [f64; 3],
    /// Radius (mm).
    pub radius: f64,
}

/// Corners `i + 2 j` of the two sides of a cell across `axis`, from its eight.
fn side(corners: &[u32; 8], axis: usize, high: usize) -> [u32; 4] {
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    std::array::from_fn(|n| corners[(high << axis) | ((n & 1) << u) | ((n >> 1) << v)])
}

/// A lattice of cells with planes at `planes` along each axis; vertices are moved by `shift`, and
/// on `surfaces`.
fn lattice(
    mesh: &mut HexMesh,
    planes: &[Vec<f64>; 3],
    place: impl Fn([usize; 3]) -> [f64; 3],
    surfaces: impl Fn([usize; 3]) -> Surfaces,
) -> Vec<([usize; 3], [u32; 8])> {
    let n = [planes[0].len(), planes[1].len(), planes[2].len()];
    let mut vertices = Vec::new();
    for k in 0..n[2] {
        for j in 0..n[1] {
            for i in 0..n[0] {
                vertices.push(mesh.vertex(place([i, j, k]), surfaces([i, j, k])));
            }
        }
    }
    let mut cells = Vec::new();
    for k in 0..n[2] - 1 {
        for j in 0..n[1] - 1 {
            for i in 0..n[0] - 1 {
                let corner = |c: usize| vertices[i + (c & 1) + n[0] * (j + (c >> 1 & 1) + n[1] * (k + (c >> 2)))];
                cells.push(([i, j, k], std::array::from_fn(corner)));
            }
        }
    }
    cells
}

/// A block from `low` to `high` (mm), held below and pressed above, with balls side by side along x
/// in its middle; ball `n` is region `n + 1` and has the curved surface `n`.
pub fn block_with_balls(low: [f64; 3], high: [f64; 3], balls: &[Ball]) -> HexMesh {
    // How far from a ball's centre the planes of its cell lie: not all the way to what comes next.
    let reach = |ball: &Ball, room: f64| ball.radius + (0.45 * (room - ball.radius)).min(0.8 * ball.radius);
    let cell = |n: usize, axis: usize, up: bool| {
        let (ball, centre) = (&balls[n], balls[n].centre[axis]);
        let next = if up { high[axis] - centre } else { centre - low[axis] };
        let other = if up { balls.get(n + 1) } else { n.checked_sub(1).map(|m| &balls[m]) };
        let room = match other {
            Some(other) if axis == 0 => ((other.centre[0] - centre).abs() - other.radius).min(next),
            _ => next,
        };
        centre + if up { reach(ball, room) } else { -reach(ball, room) }
    };
    let mut x = vec![low[0]];
    (0..balls.len()).for_each(|n| x.extend([cell(n, 0, false), cell(n, 0, true)]));
    x.push(high[0]);
    let even = |a: f64, b: f64| (0..4).map(|i| a + (b - a) * f64::from(i) / 3.0).collect::<Vec<_>>();
    if balls.is_empty() {
        x = even(low[0], high[0]);
    }
    let planes = [x, even(low[1], high[1]), even(low[2], high[2])];
    let last = planes.each_ref().map(|p| p.len() - 1);
    let place = |v: [usize; 3]| {
        let mut p = std::array::from_fn(|a| planes[a][v[a]]);
        if !balls.is_empty() {
            // Columns at the block's ends follow the ball next to them.
            let n = v[0].saturating_sub(1).min(2 * balls.len() - 1) / 2;
            for axis in [1, 2] {
                if v[axis] == 1 || v[axis] == 2 {
                    p[axis] = cell(n, axis, v[axis] == 2);
                }
            }
        }
        p
    };
    let surfaces = |v: [usize; 3]| match v[2] {
        0 => HELD,
        k if k == last[2] => PRESSED,
        _ => 0,
    };
    let mut mesh = HexMesh::default();
    for (v, corners) in lattice(&mut mesh, &planes, place, surfaces) {
        let ball = (v[1] == 1 && v[2] == 1 && v[0] % 2 == 1).then(|| v[0] / 2).filter(|&n| n < balls.len());
        match ball {
            Some(n) => ball_in_cell(&mut mesh, &corners, &balls[n], n),
            None => mesh.between(side(&corners, 2, 0), side(&corners, 2, 1), 0),
        }
    }
    mesh
}

/// A cube inside the ball, six blocks from it to the sphere, six from there to the cell's sides.
fn ball_in_cell(mesh: &mut HexMesh, cell: &[u32; 8], ball: &Ball, number: usize) {
    let region = number as u8 + 1;
    let mut shell = |radius: f64, surfaces: Surfaces| -> [u32; 8] {
        let half = radius / 3f64.sqrt();
        std::array::from_fn(|c| {
            let sign = |a: usize| if c >> a & 1 == 1 { half } else { -half };
            mesh.vertex(std::array::from_fn(|a| ball.centre[a] + sign(a)), surfaces)
        })
    };
    let (inner, sphere) = (shell(0.55 * ball.radius, 0), shell(ball.radius, CURVED << number));
    mesh.between(side(&inner, 2, 0), side(&inner, 2, 1), region);
    for axis in 0..3 {
        for high in 0..2 {
            mesh.between(side(&inner, axis, high), side(&sphere, axis, high), region);
            mesh.between(side(&sphere, axis, high), side(cell, axis, high), 0);
        }
    }
}

/// A block from `low` to `high` (mm) of layers, from the top down; `interface(n, x, y)` is the
/// height between layers n and n + 1, the curved surface n. Held below; pressed above on the
/// rectangle `punch` (low and high x, y). Planes crowd at the punch's rim.
pub(crate) fn layered_block(
    low: [f64; 3],
    high: [f64; 3],
    layers: usize,
    interface: impl Fn(usize, f64, f64) -> f64,
    punch: [[f64; 2]; 2],
) -> HexMesh {
    let crowded = |axis: usize| {
        let [from, to] = punch.map(|p| p[axis]);
        let (left, inside, right) = (from - low[axis], to - from, high[axis] - to);
        vec![
            low[axis],
            from - 0.35 * left,
            from,
            from + 0.18 * inside,
            to - 0.18 * inside,
            to,
            to + 0.35 * right,
            high[axis],
        ]
    };
    // The deepest layer is as thick as those above it together, and more: two cells.
    let rows = layers + 2;
    let planes = [crowded(0), crowded(1), (0..rows).map(|k| k as f64).collect()];
    let depth = |v: [usize; 3]| rows - 1 - v[2];
    let place = |v: [usize; 3]| {
        let (x, y) = (planes[0][v[0]], planes[1][v[1]]);
        let d = depth(v);
        let z = if d == 0 {
            high[2]
        } else if d < layers {
            interface(d - 1, x, y)
        } else if d == layers {
            let top = interface(layers - 2, x, y);
            top + 0.4 * (low[2] - top)
        } else {
            low[2]
        };
        [x, y, z]
    };
    let surfaces = |v: [usize; 3]| {
        let d = depth(v);
        let under = (2..=5).contains(&v[0]) && (2..=5).contains(&v[1]);
        match d {
            0 if under => PRESSED,
            0 => 0,
            _ if d < layers => CURVED << (d - 1),
            _ if v[2] == 0 => HELD,
            _ => 0,
        }
    };
    let mut mesh = HexMesh::default();
    for (v, corners) in lattice(&mut mesh, &planes, place, surfaces) {
        let region = (rows - 2 - v[2]).min(layers - 1) as u8;
        mesh.between(side(&corners, 2, 0), side(&corners, 2, 1), region);
    }
    mesh
}

/// Half ellipsoids, one in the other, that hang from a flat face at the height of `centre`, which
/// is held. `radii` from the outside in; surface n is curved surface n, and the outermost is
/// pressed. The space within surface n is region n.
///
/// The innermost holds a box of 4 x 4 x 3 cells; from its lower side and its four flanks a cell a
/// layer leads out.
pub fn dome(centre: [f64; 3], radii: &[[f64; 3]]) -> HexMesh {
    const CELLS: [usize; 3] = [4, 4, 3];
    // Place of a lattice point on the box, which is as wide as 1 and as deep as this.
    const DEPTH: f64 = 1.7;
    let on_box = |v: [usize; 3]| -> [f64; 3] {
        let across = |a: usize| {
            let t = 2.0 * v[a] as f64 / CELLS[a] as f64 - 1.0;
            (t * std::f64::consts::FRAC_PI_4).tan()
        };
        // Even in angle down the flanks.
        let down = (1.0 - v[2] as f64 / CELLS[2] as f64) * DEPTH.atan();
        [across(0), across(1), -down.tan()]
    };
    let mut mesh = HexMesh::default();
    let innermost = radii.len() - 1;
    let planes = CELLS.map(|n| (0..=n).map(|i| i as f64).collect::<Vec<_>>());
    let held = |v: [usize; 3]| if v[2] == CELLS[2] { HELD } else { 0 };
    let place = |v: [usize; 3]| {
        let p = on_box(v);
        std::array::from_fn(|a| centre[a] + [0.4, 0.4, 0.3][a] * radii[innermost][a] * p[a])
    };
    let cells = lattice(&mut mesh, &planes, place, held);
    for (_, corners) in &cells {
        mesh.between(side(corners, 2, 0), side(corners, 2, 1), innermost as u8);
    }
    // The same lattice point on the box and on each surface, from the inside out.
    let index = |v: [usize; 3]| v[0] + (CELLS[0] + 1) * (v[1] + (CELLS[1] + 1) * v[2]);
    let points = (CELLS[0] + 1) * (CELLS[1] + 1) * (CELLS[2] + 1);
    let mut below: Vec<u32> = (0..points as u32).collect();
    for n in (0..radii.len()).rev() {
        let mut shell = vec![u32::MAX; points];
        for k in 0..=CELLS[2] {
            for j in 0..=CELLS[1] {
                for i in 0..=CELLS[0] {
                    let inside = i > 0 && i < CELLS[0] && j > 0 && j < CELLS[1] && k > 0;
                    if !inside {
                        let p = on_box([i, j, k]);
                        let length = p.iter().map(|v| v * v).sum::<f64>().sqrt();
                        let q = std::array::from_fn(|a| centre[a] + radii[n][a] * p[a] / length);
                        let pressed = if n == 0 { PRESSED } else { 0 };
                        shell[index([i, j, k])] = mesh.vertex(q, CURVED << n | pressed | held([i, j, k]));
                    }
                }
            }
        }
        for (cell, _) in &cells {
            for (axis, high) in [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0)] {
                if cell[axis] == high * (CELLS[axis] - 1) {
                    let corners: [usize; 8] =
                        std::array::from_fn(|c| index(std::array::from_fn(|a| cell[a] + (c >> a & 1))));
                    let (low, up) = (corners.map(|c| below[c]), corners.map(|c| shell[c]));
                    mesh.between(side(&low, axis, high), side(&up, axis, high), n as u8);
                }
            }
        }
        below = shell;
    }
    mesh
}
