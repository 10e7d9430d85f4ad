//! Results do not depend on how the voxels are stored: the same tissue with its axes flipped or in
//! another order.

#[path = "../../examples/seed_chain.rs"]
#[allow(dead_code)] // its main
mod seed_chain;

use palpate::{Affine, DenseField, Grid, Mask, Phantom, PhantomKind, PhantomParams, Volume, evaluate, phantom};

/// A grid over the same places whose axis `c` is axis `axes[c]` of `grid`, the other way round where
/// `flipped[c]`; with the offset there of each voxel.
fn stored(grid: &Grid, axes: [usize; 3], flipped: [bool; 3]) -> (Grid, Vec<usize>) {
    let (old, rows) = (grid.shape(), grid.affine().rows());
    let shape = axes.map(|a| old[a]);
    let sign = flipped.map(|f| if f { -1.0 } else { 1.0 });
    let row = |r: usize| -> [f64; 4] {
        let far = |c: usize| if flipped[c] { rows[r][axes[c]] * (shape[c] - 1) as f64 } else { 0.0 };
        let origin = rows[r][3] + (0..3).map(far).sum::<f64>();
        std::array::from_fn(|c| if c == 3 { origin } else { sign[c] * rows[r][axes[c]] })
    };
    let new = Grid::new(shape, Affine::new([row(0), row(1), row(2)]).unwrap()).unwrap();
    let from = |offset: usize| {
        let v = new.voxel(offset);
        let mut at = [0; 3];
        (0..3).for_each(|c| at[axes[c]] = if flipped[c] { shape[c] - 1 - v[c] } else { v[c] });
        grid.index(at[0], at[1], at[2])
    };
    (new, (0..new.len()).map(from).collect())
}

fn volume<T: Clone>(from: &Volume<T>, grid: Grid, offsets: &[usize]) -> Volume<T> {
    Volume::from_vec(grid, offsets.iter().map(|&o| from.as_slice()[o].clone()).collect()).unwrap()
}

/// How a volume is stored: the grid's axis that each of its own is, and whether that is flipped.
type Storage = ([usize; 3], [bool; 3]);

const PLAIN: Storage = ([0, 1, 2], [false; 3]);

/// Mean error of the chain (mm) and that of no motion over the mesh, by the storage of either volume.
fn error(pair: &Phantom, initial: Storage, deformed: Storage) -> [f64; 2] {
    let (grid, offsets) = stored(pair.initial.grid(), initial.0, initial.1);
    let (there, of_deformed) = stored(pair.deformed.grid(), deformed.0, deformed.1);
    let components = (0..3).flat_map(|c| offsets.iter().map(move |&o| pair.truth.component(c)[o])).collect();
    let truth = DenseField::from_vec(grid, components).unwrap();
    let mask: Mask = volume(&pair.mask, grid, &offsets);
    let [initial, deformed] = [volume(&pair.initial, grid, &offsets), volume(&pair.deformed, there, &of_deformed)];
    let found = seed_chain::chain(&initial, &deformed, &mask).unwrap();
    let metrics = evaluate::metrics(&found.displacement, &truth, Some(&found.inside), &[]).unwrap();
    [metrics.mean_mm, metrics.identity_mm]
}

#[test]
fn the_chain_written_against_the_library_gives_the_same_error_however_voxels_are_stored() {
    let params = PhantomParams { size: [48; 3], ..PhantomParams::new(PhantomKind::Block) };
    let pair = phantom(&params).unwrap();
    let plain = error(&pair, PLAIN, PLAIN);
    assert!(plain[0] < 0.7 * plain[1], "{plain:?}");
    let flipped = ([0, 1, 2], [true, false, false]);
    let turned = ([1, 2, 0], [false; 3]);
    let swapped = ([2, 1, 0], [true, true, false]);
    for (initial, deformed) in
        [(flipped, flipped), (turned, turned), (swapped, swapped), (PLAIN, flipped), (flipped, turned)]
    {
        let other = error(&pair, initial, deformed);
        assert!((other[0] / plain[0] - 1.0).abs() < 0.1, "{initial:?} {deformed:?}: {other:?}, plain {plain:?}");
    }
}
