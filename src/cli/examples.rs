//! Examples at the end of each command's help; a test parses every one of them.

use clap::Command;

/// Of each command: what an example does, and the command line without `palpate`.
const EXAMPLES: &[(&str, &[(&str, &str)])] = &[
    (
        "field",
        &[
            ("measure inside a mask", "field before.nii.gz after.nii.gz --mask tissue.nii.gz -o results"),
            ("look at the plan first", "field before.nii.gz after.nii.gz -o results --dry-run"),
            ("more matches, wider search", "field before.nrrd after.nrrd -o results --points 20000 --search 25"),
            ("repeat an earlier run", "field before.nii.gz after.nii.gz -o again --config results/summary.json"),
        ],
    ),
    (
        "warp",
        &[
            ("an image", "warp after.nii.gz --field results/displacement.nii.gz -o back.nii.gz"),
            (
                "labels, which are recognised",
                "warp labels.nii.gz --field results/displacement.nii.gz -o labels_back.nii.gz",
            ),
            (
                "along a registration of ANTs",
                "warp after.nii.gz --transform 1Warp.nii.gz 0GenericAffine.mat --reference before.nii.gz -o back.nii.gz",
            ),
            ("points", "warp --points points.csv --field results/displacement.nii.gz -o moved.csv"),
        ],
    ),
    ("invert", &[("deformed to initial", "invert results/displacement.nii.gz -o inverse.nii.gz")]),
    (
        "compose",
        &[
            ("a warp and an affine as one field", "compose 1Warp.nii.gz 0GenericAffine.mat -o one.nii.gz"),
            ("the way back of two affine transforms", "compose a.tfm greedy:b.mat --inverse -o back.tfm"),
        ],
    ),
    (
        "convert",
        &[
            (
                "FLIRT's matrix for ITK",
                "convert fsl:a.mat --initial before.nii.gz --deformed after.nii.gz --to itk -o a.tfm",
            ),
            ("a field for FSL", "convert results --to fsl --deformed after.nii.gz -o warp.nii.gz"),
        ],
    ),
    (
        "track",
        &[
            ("files in the order they were taken", "track frame_0.nii.gz frame_1.nii.gz frame_2.nii.gz -o tracked"),
            ("a 4-D file, strain by region", "track cine.nii.gz --labels labels.nii.gz -o tracked --preset fast"),
        ],
    ),
    (
        "strain",
        &[
            ("of a result, the gauge by its noise", "strain results -o strain"),
            ("over 5 mm, by region", "strain results --gauge 5 --labels labels.nii.gz -o strain"),
            ("along fibres that run up in label 2", "strain results --labels labels.nii.gz --fibres 2=0,0,1 -o strain"),
        ],
    ),
    (
        "certify",
        &[
            ("one scan, its noise estimated", "certify before.nii.gz --mask tissue.nii.gz -o certificate"),
            ("with a repeat scan at rest", "certify before.nii.gz again.nii.gz --mask tissue.nii.gz -o certificate"),
            ("and a motion such as was measured", "certify before.nii.gz --like results -o certificate"),
        ],
    ),
    (
        "stiffness",
        &[
            (
                "regions known, moduli in kPa",
                "stiffness --field results/displacement.nii.gz --labels labels.nii.gz --held z- --load z+ --total-force 3.6 -o \
                 stiffness",
            ),
            (
                "regions looked for, moduli as ratios",
                "stiffness --field results/displacement.nii.gz --mask tissue.nii.gz -o stiffness",
            ),
            (
                "the measured motion on your own mesh",
                "stiffness --field results --labels labels.nii.gz --mesh body.inp --mesh-set HELD --mesh-set LOADED -o stiffness",
            ),
        ],
    ),
    (
        "plan",
        &[
            ("before a measurement, moduli as expected", "plan --labels labels.nii.gz --modulus 1=20,2=100 -o plan"),
            (
                "some presses, voxels and noises, 5 % wanted",
                "plan --labels labels.nii.gz --modulus 1=20,2=100 --want 5 --press 0.5,1,2 --voxel 0.5,1 --noise 0.05 -o plan",
            ),
        ],
    ),
    ("fingertip", &[("for a grasp scene", "fingertip stiffness -o fingertip.toml")]),
    (
        "batch",
        &[
            ("every pair of a table", "batch pairs.csv -o cohort"),
            ("two at a time, in 8 GB, quickly", "batch pairs.csv -o cohort --jobs 2 --memory 8 --preset fast"),
        ],
    ),
    (
        "grasp",
        &[
            ("simulate", "grasp scene.toml -o grasp"),
            ("another tip model and step", "grasp scene.toml -o grasp --model radial --step 5e-4"),
        ],
    ),
    ("grasp-analysis", &[("energy, stability, freedom", "grasp-analysis scene.toml -o analysis")]),
    ("skin", &[("press, hold and let go", "skin scene.toml -o skin")]),
    (
        "chart",
        &[
            ("on embedded cases, beside other tools", "chart -o chart --peers"),
            ("on a case of one's own", "chart --case pair -o chart"),
        ],
    ),
    (
        "stress",
        &[
            ("everything", "stress -o stress"),
            ("the field under noise and bias", "stress --part field --axis noise --axis bias -o stress"),
        ],
    ),
    (
        "phantom",
        &[
            ("a calf", "phantom calf -o pair"),
            ("known stiffness", "phantom inclusion -o block --contrast 5"),
            ("a sequence", "phantom pinch --frames 12 -o pinch"),
        ],
    ),
    (
        "evaluate",
        &[
            (
                "score a field",
                "evaluate results/displacement.nii.gz --truth pair/truth.nii.gz --mask pair/mask.nii.gz --landmarks \
                 pair/landmarks.csv",
            ),
            ("by landmarks alone", "evaluate results --landmarks landmarks.csv"),
            ("by label maps alone", "evaluate results --labels before_labels.nii.gz after_labels.nii.gz"),
            ("inverse consistency", "evaluate results --inverse back"),
        ],
    ),
    ("demo", &[("displacement and strain with a known answer", "demo"), ("every command, to a grasp", "demo --chain")]),
    (
        "markups",
        &[
            ("500 matches, where they start", "markups results/matches.csv -o matches.mrk.json --most 500"),
            ("landmarks, where they end", "markups landmarks.csv --deformed -o deformed.mrk.json"),
        ],
    ),
    (
        "info",
        &[
            ("grid, values, what can be done with it", "info before.nii.gz"),
            ("several, for a script", "info before.nii.gz after.nii.gz --json"),
        ],
    ),
    (
        "completions",
        &[
            ("bash", "completions bash > ~/.local/share/bash-completion/completions/palpate"),
            ("zsh, in a folder of $fpath", "completions zsh > ~/.zfunc/_palpate"),
            ("fish", "completions fish > ~/.config/fish/completions/palpate.fish"),
        ],
    ),
    ("man", &[("read it", "man | man -l -"), ("install it", "man -o ~/.local/share/man/man1")]),
];

/// `command` with the examples under the help of each of its subcommands.
pub fn with_examples(mut command: Command) -> Command {
    for (name, examples) in EXAMPLES {
        if command.find_subcommand(name).is_none() {
            continue;
        }
        command = command.mut_subcommand(name, |sub| {
            let before = sub.get_after_help().map(|h| format!("{h}\n\n")).unwrap_or_default();
            let lines: String = examples.iter().map(|(what, line)| format!("\n  # {what}\n  palpate {line}")).collect();
            sub.after_help(format!("{before}Examples:{lines}"))
        });
    }
    command
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::Cli;
    use clap::CommandFactory;

    #[test]
    fn every_command_has_its_examples_once() {
        let names: Vec<&str> = EXAMPLES.iter().map(|e| e.0).collect();
        let twice = (1..names.len()).find(|&i| names[..i].contains(&names[i])).map(|i| names[i]);
        assert_eq!(twice, None);
    }

    #[test]
    fn every_command_has_examples_and_every_example_parses() {
        let command = Cli::command();
        for sub in command.get_subcommands() {
            assert!(EXAMPLES.iter().any(|(name, _)| *name == sub.get_name()), "{} has no example", sub.get_name());
        }
        let there = |name: &str| command.find_subcommand(name).is_some();
        for (name, line) in
            EXAMPLES.iter().filter(|e| there(e.0)).flat_map(|(name, list)| list.iter().map(move |l| (name, l.1)))
        {
            let line = line.split(['>', '|']).next().unwrap_or_default();
            let words = std::iter::once("palpate").chain(line.split_whitespace());
            let parsed = Cli::command().try_get_matches_from(words);
            assert!(parsed.is_ok(), "palpate {line}: {}", parsed.err().map(|e| e.to_string()).unwrap_or_default());
            assert!(line.starts_with(name), "{line} stands under {name}");
        }
    }
}
