//! A plate pushes, it does not pull, and nothing goes through it: facets of a loaded patch under tension are let go, and those
//! beyond the plate touch it.

use crate::stiffness::body::Body;
use crate::stiffness::elements::Point;
use crate::stiffness::elements::jacobian;
use crate::stiffness::forward::Problem;
use crate::stiffness::law::stress;
use crate::stiffness::patches::Patch;
use crate::types::space::dot;

/// Normal stress (kPa, tension positive) of the solution `x` on each facet of a patch, from the element behind it.
pub fn normal_stress(problem: &Problem<'_>, patch: &Patch, x: &[f64]) -> Vec<f64> {
    let body: &Body = problem.body;
    let one = |&f: &usize| {
        let facet = &body.surface[f];
        let e = facet.element as usize;
        let cell = &body.cells[e];
        let mut l = [0.0; 4];
        for i in 0..4 {
            if facet.nodes[..3].contains(&cell[i]) {
                l[i] = 1.0 / 3.0;
            }
        }
        let (gradient, _) = jacobian(&cell.map(|n| body.places[n as usize]), l);
        let point = Point { gradient, pressure: l, weight: 0.0 };
        stress(problem.law, &point, problem.materials[e], &body.gather(x, e)).map_or(0.0, |(s, _)| {
            (0..3).map(|i| (0..3).map(|j| s[i][j] * patch.normal[i] * patch.normal[j]).sum::<f64>()).sum()
        })
    };
    patch.facets.iter().map(one).collect()
}

/// The patch without facets under tension beyond 5 % of the mean pressure, and with those around it that went through the
/// plate; none when nothing changes or too little would be left. `change` are the plate's parameters, `voxel` in mm.
pub fn adjusted(problem: &Problem<'_>, patch: &Patch, change: &[f64], x: &[f64], voxel: f64) -> Option<Patch> {
    let body = problem.body;
    let stress = normal_stress(problem, patch, x);
    let area = |i: usize| body.surface[patch.facets[i]].area;
    let total: f64 = (0..stress.len()).map(area).sum();
    let mean: f64 = (0..stress.len()).map(|i| -stress[i] * area(i)).sum::<f64>() / total;
    let pulled: Vec<usize> =
        (0..stress.len()).filter(|&i| stress[i] > 0.05 * mean.abs()).map(|i| patch.facets[i]).collect();
    if 4 * pulled.len() > 3 * stress.len() {
        return None;
    }
    let through = |f: &usize| {
        let facet = &body.surface[*f];
        let beyond =
            |n: &u32| patch.beyond(body.places[*n as usize], body.displacement(x, *n), change) > THROUGH * voxel;
        patch.facets.binary_search(f).is_err()
            && dot(facet.normal, patch.normal) > 0.3
            && facet.nodes.iter().filter(|n| beyond(n)).count() >= 3
    };
    let added: Vec<usize> = (0..body.surface.len()).filter(through).collect();
    if (pulled.len() + added.len()) as f64 <= FEW * patch.facets.len() as f64 {
        return None;
    }
    let mut facets: Vec<usize> = patch.facets.iter().copied().filter(|f| pulled.binary_search(f).is_err()).collect();
    facets.extend(added);
    facets.sort_unstable();
    Some(patch.on_facets(body, facets))
}

/// Part of the facets that may be wrong: on the edge there is next to no pressure.
const FEW: f64 = 0.02;
/// A node this far (voxels) beyond the plate went through it.
const THROUGH: f64 = 0.02;
