//! However the voxels of the two volumes are stored, the field in world mm is the same.

use palpate::numerics::sampling::displacement;
use palpate::pipeline::field::{FieldResult, run, run_lent};
use palpate::pipeline::known::Known;
use palpate::synth::{MotionKind, Phantom, PhantomKind, PhantomParams, phantom};
use palpate::types::{Affine, FieldParams, Grid, Mask, Volume, VoxelPoint};

const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];

/// The same voxels stored with stored axis `s` along axis `order[s]`, backwards where `flip` says
/// so.
fn stored<T: Copy + Default + Send + Sync>(v: &Volume<T>, order: [usize; 3], flip: [bool; 3]) -> Volume<T> {
    let from = *v.grid();
    let shape = order.map(|a| from.shape()[a]);
    let voxel = |at: [usize; 3]| {
        let mut out = [0; 3];
        (0..3).for_each(|s| out[order[s]] = if flip[s] { shape[s] - 1 - at[s] } else { at[s] });
        out
    };
    let rows = from.affine().rows();
    let origin = from.affine().to_world(VoxelPoint(voxel([0; 3]).map(|i| i as f64))).0;
    let column = |r: usize, s: usize| rows[r][order[s]] * if flip[s] { -1.0 } else { 1.0 };
    let rows = std::array::from_fn(|r| [column(r, 0), column(r, 1), column(r, 2), origin[r]]);
    let grid = Grid::new(shape, Affine::new(rows).unwrap()).unwrap();
    Volume::from_voxels(grid, |at, _| {
        let [i, j, k] = voxel(grid.voxel(at));
        v.as_slice()[from.index(i, j, k)]
    })
}

fn flips(bits: usize) -> [bool; 3] {
    [0, 1, 2].map(|a| bits >> a & 1 == 1)
}

fn pair(params: &PhantomParams) -> Phantom {
    phantom(params).unwrap()
}

fn measure(initial: &Volume, deformed: &Volume, mask: &Mask) -> FieldResult {
    run(initial, deformed, Some(mask), &FieldParams::default(), &|_, _| {}).unwrap()
}

/// Largest distance of two fields over the voxels of the first one's grid (mm).
fn apart(a: &FieldResult, b: &FieldResult) -> f64 {
    let grid = *a.displacement.grid();
    let distance = |at: usize| {
        let [i, j, k] = grid.voxel(at);
        let here = grid.world(i, j, k);
        let (p, q) = (displacement(&a.displacement, here), displacement(&b.displacement, here));
        (0..3).map(|c| (p[c] - q[c]).powi(2)).sum::<f64>().sqrt()
    };
    (0..grid.len()).step_by(7).map(distance).fold(0.0, f64::max)
}

#[test]
fn the_48_orientations_of_either_volume_give_one_field() {
    let params = PhantomParams { motion: MotionKind::Smooth, amplitude: 3.0, ..PhantomParams::new(PhantomKind::Block) };
    let p = pair(&params.sized(28));
    let base = measure(&p.initial, &p.deformed, &p.mask);
    let voxel = p.initial.grid().spacing()[0];
    for way in 0..48 {
        // Each in all ways once, never both in the same way.
        let other = (way * 5 + 7) % 48;
        let (here, there) = ((ORDERS[way / 8], flips(way % 8)), (ORDERS[other / 8], flips(other % 8)));
        let initial = stored(&p.initial, here.0, here.1);
        let found = measure(&initial, &stored(&p.deformed, there.0, there.1), &stored(&p.mask, here.0, here.1));
        assert!(found.displacement.grid().same_as(initial.grid()));
        let distance = apart(&base, &found);
        assert!(distance < 1e-3 * voxel, "initial {here:?}, deformed {there:?}: {distance:e} mm apart");
        assert_eq!(found.summary.counts, base.summary.counts);
        // The uncertainty too, voxel by voxel and as a volume.
        let (a, b) = (base.uncertainty.volume(), found.uncertainty.volume());
        let at = a.as_slice().len() / 3;
        let [i, j, k] = a.grid().voxel(at);
        let there = b.grid().affine().to_voxel(a.grid().world(i, j, k)).0.map(|x| x.round() as usize);
        let offset = b.grid().index(there[0], there[1], there[2]);
        assert!((a.as_slice()[at] - b.as_slice()[offset]).abs() < 1e-4);
        let unlike = |at: usize| (found.uncertainty.at(at) - b.as_slice()[at]).abs() > 1e-5;
        assert!(!(0..b.grid().len()).step_by(31).any(unlike), "{here:?}");
    }
}

/// The command line lends its volumes, so that those whose axes run otherwise are not held twice.
#[test]
fn lent_volumes_give_the_same_field_and_come_back() {
    let params = PhantomParams { motion: MotionKind::Smooth, amplitude: 3.0, ..PhantomParams::new(PhantomKind::Block) };
    let p = pair(&params.sized(28));
    for (here, there) in
        [(([0, 1, 2], 0), ([0, 1, 2], 0)), (([0, 1, 2], 3), ([0, 1, 2], 3)), (([2, 0, 1], 5), ([1, 0, 2], 2))]
    {
        let initial = stored(&p.initial, here.0, flips(here.1));
        let deformed = stored(&p.deformed, there.0, flips(there.1));
        let mask = stored(&p.mask, here.0, flips(here.1));
        let wanted = measure(&initial, &deformed, &mask);
        let (found, back) =
            run_lent(initial.clone(), deformed.clone(), &Known::mask(Some(&mask)), &FieldParams::default(), &|_, _| {})
                .unwrap();
        assert_eq!(back, [initial, deformed]);
        assert_eq!(found.displacement, wanted.displacement);
        assert_eq!(found.uncertainty.volume(), wanted.uncertainty.volume());
    }
}

#[test]
fn oblique_and_sheared_volumes_may_be_stored_in_any_way() {
    let params = PhantomParams { motion: MotionKind::Smooth, amplitude: 3.0, ..PhantomParams::new(PhantomKind::Block) };
    let p = pair(&params.sized(28));
    let (sin, cos) = 25f64.to_radians().sin_cos();
    for rows in [
        [[1.7 * cos, -1.7 * sin, 0.0, -20.0], [1.7 * sin, 1.7 * cos, 0.0, -30.0], [0.0, 0.0, 1.7, 4.0]],
        [[1.7, 0.3, 0.0, -20.0], [0.0, 1.7, 0.2, -30.0], [0.1, 0.0, 1.7, 4.0]],
    ] {
        let grid = Grid::new(p.initial.grid().shape(), Affine::new(rows).unwrap()).unwrap();
        let on = |v: &Volume| Volume::from_vec(grid, v.as_slice().to_vec()).unwrap();
        let (initial, deformed) = (on(&p.initial), on(&p.deformed));
        let mask = Mask::from_vec(grid, p.mask.as_slice().to_vec()).unwrap();
        let base = measure(&initial, &deformed, &mask);
        for (order, flip) in [([2, 0, 1], [true, false, true]), ([1, 0, 2], [false, true, false])] {
            let turned = stored(&initial, order, flip);
            let found = measure(&turned, &stored(&deformed, [0, 2, 1], [true; 3]), &stored(&mask, order, flip));
            let distance = apart(&base, &found);
            assert!(distance < 1e-3 * 1.7, "{rows:?} {order:?} {flip:?}: {distance:e} mm apart");
        }
    }
}

#[test]
fn a_slice_in_any_plane_gives_one_field() {
    let p = pair(&PhantomParams::new(PhantomKind::Slice).sized(96));
    let base = measure(&p.initial, &p.deformed, &p.mask);
    for (order, flip) in [([2, 0, 1], [true, false, true]), ([1, 2, 0], [false, true, false])] {
        let found = measure(
            &stored(&p.initial, order, flip),
            &stored(&p.deformed, [1, 0, 2], [true; 3]),
            &stored(&p.mask, order, flip),
        );
        assert!(apart(&base, &found) < 1e-3 * p.initial.grid().spacing()[0]);
    }
}
