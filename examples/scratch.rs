use palpate::grasp::simulate::simulate;
use palpate::types::scene::*;
use palpate::types::FingertipModel;
fn main() {
    for model in FingertipModel::ALL { for form in [Formulation::Minimal, Formulation::Multipliers] {
        let mut s = Scene::reference();
        s.fingertip.model = model.1; s.integrator.formulation = form;
        println!("--- {} {:?}", model.0, form);
        show(&s);
    }}
    for w in [0.055, 0.052, 0.05,0.045] { println!("--- W {w}"); show(&Scene::reference().with_width(w)); }
}
fn show(s: &Scene) {
    match simulate(s, &|_| {}) { Ok(r) => {
        for m in &r.motions { println!("{} {:.8?} fn {:.4?} ft {:.4?}", m.step, m.row(), m.reached.normal_force, m.reached.tangential_force); }
        for e in &r.events { println!("{:?} t={} finger {:?}: {}", e.kind, e.time, e.finger, e.what); }
        println!("drift {:.3e} {:?} growth {} steps {} completed {}", r.energy_drift, r.constraint_drift, r.step_growth, r.steps, r.completed);
    } Err(e) => println!("ERR {e}") }
}
