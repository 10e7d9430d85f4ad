use palpate::grasp::simulate::simulate;
use palpate::types::scene::*;
fn main() {
    for h in [1e-3, 2.5e-4] {
        let mut s = Scene::reference(); s.integrator.step = h;
        let m = simulate(&s, &|_| {}).unwrap();
        for gh in [1e-6,1e-4,1e-3,3e-3,1e-2,3e-2, 0.1] {
            s.integrator.baumgarte = gh / h; s.integrator.formulation = Formulation::Multipliers;
            match simulate(&s, &|_| {}) { Ok(r) => {
            let diff = m.samples.iter().zip(&r.samples).flat_map(|(a,b)| (1..6).map(move |k| (a.row()[k]-b.row()[k]).abs())).fold(0.0, f64::max);
            println!("h {h} gh {gh} drift {:?} diff {:.2e} edrift {:.1e} {:.1e}", r.constraint_drift, diff, m.energy_drift, r.energy_drift);
            for e in r.events { println!("{:?} {}", e.kind, e.time); } }
            Err(e) => println!("h {h} gh {gh} {e}") }
        }
    }
    for tol in [0.0;0] {
        let mut s = Scene::reference(); s.integrator.method = Method::Adaptive; s.integrator.tolerance = tol;
        let m = simulate(&s, &|_| {}).unwrap();
        s.integrator.formulation = Formulation::Multipliers;
        for g in [300., 1000., 3000.] {
        s.integrator.baumgarte = g;
        let r = simulate(&s, &|_| {}).unwrap();
            let diff = m.samples.iter().zip(&r.samples).flat_map(|(a,b)| (1..6).map(move |k| (a.row()[k]-b.row()[k]).abs())).fold(0.0, f64::max);
            println!("tol {tol} g {g} steps {} drift {:?} diff {:.2e}", r.steps, r.constraint_drift, diff);
        }
    }
}
