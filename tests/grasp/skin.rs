//! Layered skin against closed forms, and `palpate skin` as a user meets it.

use palpate::io;
use palpate::pipeline;
use palpate::skin::{block, column};
use palpate::types::skin::{ElementKind, Layer, SkinBlock, SkinLoad, SkinSample, SkinScene};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

const SCENE: &str = include_str!("../../examples/skin.toml");

fn layer(element: ElementKind, thickness: f64, e0: f64, c0: f64, maxwell: &[[f64; 2]]) -> Layer {
    Layer { name: "a".into(), thickness, element, e0, c0, maxwell: maxwell.to_vec(), c_unload: Vec::new() }
}

/// 0.1 mm in 1 s, held 10 s, until 41 s.
fn scene(layers: Vec<Layer>) -> SkinScene {
    let load = SkinLoad { displacement: 1e-4, ramp: 1.0, hold: 10.0, end: 41.0 };
    let scene = SkinScene { load, layers, block: SkinBlock { width: 0.02, indenter: 0.02, poisson: 0.0 } };
    scene.check().unwrap();
    scene
}

fn close(found: f64, truth: f64, tolerance: f64, what: &str) {
    assert!((found - truth).abs() <= tolerance * truth.abs().max(1e-12), "{what}: {found} is not {truth}");
}

#[test]
fn kelvin_voigt_has_its_closed_form() {
    let (h, e, c) = (2e-3, 2e4, 5e3);
    let s = scene(vec![layer(ElementKind::KelvinVoigt, h, e, c, &[])]);
    let rate = s.load.displacement / s.load.ramp / h;
    let out = column::respond(&s);
    let mut kept = 0.0;
    // Each corner is sampled on both sides: the ramp's last sample, then the hold's first.
    let (mut ramp, mut hold) = (true, true);
    for (at, p) in out.iter().enumerate() {
        ramp &= at == 0 || p.time > out[at - 1].time;
        hold &= ramp || p.stress > 0.0;
        if ramp {
            close(p.stress, e * rate * p.time + c * rate, 1e-10, "ramp");
        } else if hold {
            close(p.stress, e * rate, 1e-10, "hold");
            kept = p.strain[0];
        } else {
            assert_eq!(p.stress, 0.0);
            close(p.strain[0], kept * (-(p.time - 11.0) * e / c).exp(), 1e-8, "free");
        }
        close(p.displacement, h * p.strain[0], 1e-12, "depth");
    }
}

#[test]
fn a_standard_linear_solid_relaxes_as_it_should() {
    // One is slow, one fast, one very fast.
    for tau in [10.0, 0.19, 0.015, 1e-4] {
        let (h, e0, e1) = (1.5e-3, 2e4, 6e4);
        let s = scene(vec![layer(ElementKind::StandardLinearSolid, h, e0, 0.0, &[[e1, e1 * tau]])]);
        let rate = s.load.displacement / h;
        for p in column::respond(&s).iter().filter(|p| p.stress != 0.0) {
            let branch = |t: f64| e1 * rate * tau * -(-t / tau).exp_m1();
            let truth = match p.time {
                t if t <= 1.0 => e0 * rate * t + branch(t),
                t => e0 * rate + branch(1.0) * (-(t - 1.0) / tau).exp(),
            };
            close(p.stress, truth, 1e-8, &format!("tau {tau}, {} s", p.time));
        }
    }
}

#[test]
fn what_stays_is_the_impulse_over_the_dashpots() {
    let three = layer(ElementKind::ThreeElement, 1e-3, 0.0, 3e4, &[[4e4, 2e4]]);
    let five = layer(ElementKind::FiveElement, 2e-3, 0.0, 5e4, &[[2e5, 3e3], [3e4, 3e5]]);
    for layers in [vec![three.clone()], vec![five.clone()], vec![three, five]] {
        let mut s = scene(layers);
        s.load.end = 5000.0;
        let last = column::respond(&s).pop().unwrap();
        for (layer, strain) in s.layers.iter().zip(&last.strain) {
            let stays = column::residual(layer, last.impulse).unwrap();
            assert!(stays > 1e-3);
            close(*strain, stays, 1e-8, &format!("{:?}", layer.element));
        }
    }
}

#[test]
fn a_long_hold_leaves_the_springs_alone() {
    let solid = |h: f64, e0: f64, tau: f64| layer(ElementKind::StandardLinearSolid, h, e0, 10.0, &[[3e4, 3e4 * tau]]);
    let mut s = scene(vec![solid(1e-4, 1e6, 0.015), solid(1.5e-3, 2e4, 0.2), solid(2e-3, 1e4, 10.0)]);
    s.load.hold = 2000.0;
    s.load.end = 2001.5;
    let held = column::respond(&s).into_iter().rfind(|p| p.stress > 0.0).unwrap();
    let compliance: f64 = s.layers.iter().map(|l| l.thickness / l.e0).sum();
    close(held.stress, s.load.displacement / compliance, 1e-8, "hold");
}

/// Gigapascals over 15 micrometres held for minutes were lost in rounding: 66 MPa for 50, and an
/// impulse below zero.
#[test]
fn a_thin_stiff_layer_keeps_its_closed_form() {
    let (h, e0, e1, tau) = (1.5e-5, 1e9, 1e9, 60.0);
    for hold in [10.0, 300.0, 86_400.0] {
        let mut s = scene(vec![layer(ElementKind::StandardLinearSolid, 1e-3, e0, 0.0, &[[e1, e1 * tau]])]);
        (s.layers[0].thickness, s.load.displacement, s.load.hold, s.load.end) = (h, 7.5e-7, hold, 2.0 * hold + 1.0);
        s.check().unwrap();
        let out = column::respond(&s);
        let held = out.iter().rfind(|p| p.stress > 0.0).unwrap();
        let rate = s.load.displacement / s.load.ramp / h;
        let peak = e1 * rate * tau * -(-s.load.ramp / tau).exp_m1();
        let strain = s.load.displacement / h;
        close(held.stress, e0 * strain + peak * (-hold / tau).exp(), 1e-9, "hold");
        let relaxing = peak * tau * -(-hold / tau).exp_m1();
        let pressing = e0 * 0.5 * strain + e1 * rate * tau * (1.0 - tau * -(-1.0 / tau).exp_m1());
        close(held.impulse, e0 * strain * hold + relaxing + pressing, 1e-8, "impulse");
        assert!(column::precision(&s) < 1e-10);
    }
}

/// Layers with lone dashpots and without, stiff ones among them, by small explicit steps.
#[test]
fn mixed_stacks_agree_with_small_steps() {
    let soft = layer(ElementKind::StandardLinearSolid, 1e-3, 2e4, 0.0, &[[3e4, 9e3]]);
    let damped = layer(ElementKind::KelvinVoigt, 1.5e-3, 1e4, 4e3, &[]);
    let s = scene(vec![soft.clone(), damped.clone()]);
    let exact = column::respond_at(&s, &[vec![0.5, 1.0], vec![1.0, 1.7, 3.0], vec![]]);
    // States: dashpot strain of the first, strain of the second; sigma from h1 e1 + h2 e2 = u.
    let ([e0, e1, c1], [e2, c2]) = ([2e4, 3e4, 9e3], [1e4, 4e3]);
    let sigma = |u: f64, d: f64, b: f64| (u - 1.5e-3 * b) / 1e-3 * (e0 + e1) - e1 * d;
    let rates = |u: f64, [d, b]: [f64; 2]| {
        let p = sigma(u, d, b);
        [e1 / c1 * ((p + e1 * d) / (e0 + e1) - d), (p - e2 * b) / c2]
    };
    let depth = |t: f64| 1e-4 * t.min(1.0);
    let (steps, mut y, mut at) = (40_000, [0.0; 2], 0);
    let h = 1.0 / f64::from(steps);
    for n in 0..3 * steps {
        let t = f64::from(n) * h;
        let along = |k: [f64; 2], f: f64| [y[0] + f * h * k[0], y[1] + f * h * k[1]];
        let k1 = rates(depth(t), y);
        let k2 = rates(depth(t + 0.5 * h), along(k1, 0.5));
        let k3 = rates(depth(t + 0.5 * h), along(k2, 0.5));
        let k4 = rates(depth(t + h), along(k3, 1.0));
        for i in 0..2 {
            y[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
        }
        while at < exact.len() && exact[at].time <= t + 1.5 * h && (exact[at].time - (t + h)).abs() < 1e-9 {
            close(exact[at].stress, sigma(depth(t + h), y[0], y[1]), 1e-8, &format!("{} s", exact[at].time));
            at += 1;
        }
    }
    assert_eq!(at, exact.len());
}

#[test]
fn the_way_to_a_time_does_not_matter() {
    let s = io::read_skin_scene(Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/skin.toml")).unwrap();
    let direct = column::respond_at(&s, &[vec![1.0], vec![7.0], vec![15.0, 41.0]]);
    let fine: Vec<f64> = (1..=400).map(|i| 1.0 + f64::from(i) * 0.015).collect();
    let steps = column::respond_at(&s, &[vec![0.001, 1.0], fine, vec![11.5, 15.0, 15.1, 41.0]]);
    let at = |list: &[SkinSample], time: f64| list.iter().rfind(|p| (p.time - time).abs() < 1e-9).unwrap().clone();
    for time in [1.0, 7.0, 15.0, 41.0] {
        let (a, b) = (at(&direct, time), at(&steps, time));
        close(a.displacement, b.displacement, 1e-8, "depth");
        close(a.stress, b.stress, 1e-8, "stress");
    }
}

#[test]
fn dual_moduli_dashpots_change_when_the_load_goes() {
    let mut solid = layer(ElementKind::KelvinVoigt, 1e-3, 2e4, 5e3, &[]);
    let alike = column::respond(&scene(vec![solid.clone()]));
    solid.c_unload = vec![4e4];
    let dual = column::respond(&scene(vec![solid]));
    for (a, b) in alike.iter().zip(&dual) {
        if a.stress > 0.0 {
            assert_eq!(a, b);
        }
    }
    let last = dual.last().unwrap();
    close(last.strain[0], 0.1 * (-30.0f64 * 2e4 / 4e4).exp(), 1e-8, "free");

    let mut fluid = layer(ElementKind::ThreeElement, 1e-3, 0.0, 3e4, &[[4e4, 2e4]]);
    assert!(column::residual(&fluid, 1.0).is_some());
    fluid.c_unload = vec![3e5, 2e5];
    assert_eq!(column::residual(&fluid, 1.0), None);
}

/// Largest difference of the stress, over the largest stress, and of the depth, over the
/// indentation.
fn apart(scene: &SkinScene) -> [f64; 2] {
    let (exact, block) = (column::respond(scene), block::respond(scene).unwrap());
    let top = exact.iter().map(|p| p.stress).fold(0.0, f64::max);
    let mut worst = [0.0f64; 2];
    for p in &block.samples {
        // The column has both sides of a corner, the block the side before it.
        let Some(q) = exact.iter().find(|q| (q.time - p.time).abs() < 1e-12) else { continue };
        worst[0] = worst[0].max((p.stress - q.stress).abs() / top);
        worst[1] = worst[1].max((p.displacement - q.displacement).abs() / scene.load.displacement);
    }
    worst
}

#[test]
fn a_thin_wide_block_is_a_column() {
    let skin = io::read_skin_scene(Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/skin.toml")).unwrap();
    let elastic = scene(vec![layer(ElementKind::StandardLinearSolid, 1e-3, 2e4, 0.0, &[[6e4, 1.2e4]])]);
    for (name, s) in [("skin", skin), ("one layer", elastic)] {
        let t = s.thickness();
        // The whole width pressed, and a punch a hundred times as wide as the skin is thick.
        for [width, indenter] in [[10.0 * t, 10.0 * t], [160.0 * t, 100.0 * t]] {
            let wide = SkinScene { block: SkinBlock { width, indenter, poisson: 0.0 }, ..s.clone() };
            let [stress, depth] = apart(&wide);
            assert!(stress < 0.02 && depth < 0.02, "{name}, {:.0} thick: {stress:.4} {depth:.4}", indenter / t);
        }
    }
}

#[test]
fn the_block_does_not_lock() {
    // A confined layer: the punch is as wide as the block and all but incompressible tissue has
    // nowhere to go but out at the side. Halfway between free and confined, it must not stiffen
    // with nu as a locked mesh does.
    let stress = |poisson: f64| {
        let mut s = scene(vec![layer(ElementKind::StandardLinearSolid, 1e-2, 2e4, 0.0, &[[1.0, 1.0]])]);
        s.block = SkinBlock { width: 0.02, indenter: 0.02, poisson };
        block::respond(&s).unwrap().samples.iter().map(|p| p.stress).fold(0.0, f64::max)
    };
    let (soft, firm) = (stress(0.49), stress(0.4999));
    assert!(firm > soft && firm < 1.15 * soft, "{soft} {firm}");
}

/// Stacks of unlike elements had no layer to stand beside.
#[test]
fn every_mix_of_elements_has_one_layer_beside_it() {
    let kinds = [
        layer(ElementKind::KelvinVoigt, 1e-3, 2e4, 5e3, &[]),
        layer(ElementKind::StandardLinearSolid, 1.5e-3, 3e4, 0.0, &[[5e4, 2e4]]),
        layer(ElementKind::StandardLinearSolid, 1e-3, 1e4, 400.0, &[[2e4, 4e3]]),
        layer(ElementKind::ThreeElement, 2e-3, 0.0, 2e3, &[[4e4, 2e5]]),
        layer(ElementKind::FiveElement, 1e-3, 0.0, 3e3, &[[2e5, 3e3], [3e4, 3e5]]),
    ];
    for a in 0..kinds.len() {
        for b in 0..kinds.len() {
            let mut layers = vec![kinds[a].clone(), kinds[b].clone()];
            layers[1].name = "b".into();
            let s = scene(layers);
            let outcome = pipeline::skin::run(&s);
            let (one, response) = outcome.single.as_ref().unwrap();
            one.check().unwrap();
            assert_eq!(response.len(), outcome.column.len());
            let top = outcome.column.iter().map(|p| p.stress).fold(0.0, f64::max);
            let last = |r: &[SkinSample]| r.last().unwrap().displacement / s.load.displacement;
            let off = (last(response) - last(&outcome.column)).abs();
            let stress = response.iter().zip(&outcome.column).map(|(p, q)| (p.stress - q.stress).abs() / top);
            println!("{a} {b}: depth {off:.3}, stress {:.3}", stress.clone().fold(0.0, f64::max));
            // Fitted ones come near; means of parts do where layers are alike.
            if s.without_layers().is_none() {
                assert!(off < 0.1, "{a} {b}: {off}");
            }
            // A layer that flows lets the stack flow.
            let flows = s.layers.iter().any(|l| l.e0 == 0.0);
            assert_eq!(one.layers[0].e0 == 0.0, flows);
        }
    }
}

/// Numbers that are none were printed.
#[test]
fn nothing_that_is_no_number_is_printed() {
    for change in [
        ("c0 = 200.0", "c0 = 1.0e-6"),
        ("end = 41.0", "end = 1.0e9"),
        ("c0 = 400.0", "c0 = 1.0e12"),
        ("hold = 10.0", "hold = 0.0"),
    ] {
        assert!(SCENE.contains(change.0));
        let (out, err, folder) = run(&SCENE.replacen(change.0, change.1, 1), 0);
        let results = folder.path().join("out");
        let files =
            ["response.csv", "summary.json", "report.html"].map(|f| fs::read_to_string(results.join(f)).unwrap());
        for text in files.iter().chain([&out, &err]) {
            assert!(!text.contains("NaN") && !text.contains("inf "), "{change:?}: {out}{err}");
        }
    }
}

fn run(text: &str, code: i32) -> (String, String, TempDir) {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("scene.toml"), text).unwrap();
    let mut command = assert_cmd::Command::new(assert_cmd::cargo::cargo_bin!("palpate"));
    let output = command.current_dir(folder.path()).args(["skin", "scene.toml", "-o", "out"]).output().unwrap();
    let [out, err] = [output.stdout, output.stderr].map(|b| String::from_utf8_lossy(&b).into_owned());
    assert_eq!(output.status.code(), Some(code), "{out}{err}");
    (out, err, folder)
}

#[test]
fn the_command_writes_what_is_promised() {
    let (out, err, folder) = run(SCENE, 0);
    assert!(out.starts_with("3 layers, 3.65 mm thick") && err.is_empty(), "{out}{err}");
    let results = folder.path().join("out");
    let response = fs::read_to_string(results.join("response.csv")).unwrap();
    let head = "time,stress_pa,displacement_m,strain_epidermis,strain_dermis,strain_hypodermis\n";
    assert!(response.starts_with(head), "{response:.100}");
    assert!(response.lines().skip(1).all(|l| l.split(',').all(|v| v.parse::<f64>().unwrap().is_finite())));
    let summary: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(results.join("summary.json")).unwrap()).unwrap();
    assert_eq!(summary["layers"].as_array().unwrap().len(), 3);
    assert!(summary["column"]["peak_stress_pa"].as_f64().unwrap() > 2000.0);
    let page = fs::read_to_string(results.join("report.html")).unwrap();
    assert!(page.contains("With layers, at 41 s") && page.contains("One layer, at 41 s") && !page.contains("NaN"));
}

#[test]
fn bad_scenes_are_refused() {
    for (from, to, parts) in [
        ("thickness = 1.5e-4", "thickness = 0.0", ["layer 'epidermis' thickness", "above 0"]),
        ("e0 = 2.24e4", "e0 = -2.24e4", ["layer 'dermis' e0", "above 0"]),
        ("maxwell = [[2.0e4, 2.0e5]]", "maxwell = [[2.0e4, -2.0e5]]", ["layer 'hypodermis' maxwell", "above 0"]),
        (
            "element = \"standard-linear-solid\"\ne0 = 1.0e6",
            "element = \"standard-linear-sold\"\ne0 = 1.0e6",
            ["standard-linear-sold", "did you mean"],
        ),
        (
            "element = \"standard-linear-solid\"\ne0 = 1.0e6",
            "element = \"five-element\"\ne0 = 1.0e6",
            ["e0", "no lone spring"],
        ),
        ("thickness = 1.5e-3", "thicknes = 1.5e-3", ["thicknes", "did you mean 'thickness'"]),
        ("hold = 10.0", "hold = 50.0", ["load.end", "after ramp + hold"]),
        ("displacement = 3.0e-4", "displacement = 4.0e-3", ["load.displacement", "less than the thickness"]),
        ("poisson = 0.45", "poisson = 0.5", ["block.poisson", "below 0.5"]),
        ("[load]", "[loads]", ["loads", "did you mean 'load'"]),
        ("ramp = 1.0", "ramp = \"1\"", ["ramp", "docs/reference/skin.md"]),
    ] {
        assert!(SCENE.contains(from), "{from}");
        let (out, err, folder) = run(&SCENE.replacen(from, to, 1), 1);
        assert!(out.is_empty() && err.starts_with("error: scene.toml"), "{out}{err}");
        parts.iter().for_each(|p| assert!(err.contains(p), "should say {p:?}: {err}"));
        assert!(!folder.path().join("out").exists());
    }
    let (_, err, _) = run("[load]\ndisplacement = 1e-3\nramp = 1.0\nhold = 1.0\nend = 3.0\n", 1);
    assert!(err.contains("[[layer]]"), "{err}");
}
