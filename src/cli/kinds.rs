//! What the files of palpate are called: volumes by the description in their header, tables by
//! their columns.

/// How a description begins, and what such an image is.
const IMAGES: [(&str, &str); 24] = [
    ("palpate: deformed at x + u(x)", "deformed volume, warped to the initial one"),
    ("palpate: Jacobian determinant", "Jacobian determinant of a motion"),
    ("palpate: 1 sigma of u", "uncertainty of a displacement, mm"),
    ("palpate: bodies", "bodies that a field was measured in"),
    ("samples of the error of u", "draws of a field's error"),
    ("palpate: 1 sigma of strain", "standard deviation of strain"),
    ("palpate: principal strains", "principal strains, largest first"),
    ("palpate: principal directions", "directions of the principal strains"),
    ("palpate: largest shear strain", "largest shear strain"),
    ("palpate: relative change of volume", "relative change of volume"),
    ("palpate: green-lagrange strain", "Green-Lagrange strain"),
    ("palpate: Green-Lagrange strain", "Green-Lagrange strain"),
    ("palpate: small strain", "small strain"),
    ("palpate: logarithmic strain", "logarithmic strain"),
    ("palpate: Young's modulus, kPa", "Young's modulus, kPa"),
    ("palpate: Young's modulus over", "Young's modulus over the reference region's"),
    ("palpate: sd of Young's modulus", "standard deviation of Young's modulus"),
    ("palpate: length of the residual", "residual of a stiffness map, mm"),
    ("palpate: regions found", "regions that stiffness has found"),
    ("palpate: smallest displacement", "smallest displacement above noise, mm"),
    ("palpate: labels, warped", "label map, warped"),
    ("palpate: warped", "volume, warped"),
    ("palpate phantom: Young's modulus", "exact Young's modulus of a phantom, kPa"),
    ("palpate phantom: tissue regions", "label map or mask"),
];

/// What an image with this description is, where palpate has written it.
pub fn image(description: &str) -> Option<&'static str> {
    IMAGES.iter().find(|known| description.starts_with(known.0)).map(|known| known.1)
}

/// What a table is, columns that no other kind has all of, and a command that takes it.
const TABLES: [(&str, &[&str], &str); 26] = [
    ("trajectories of tracked points", &["point", "frame", "x", "y", "z", "sigma"], ""),
    ("strain of regions over time", &["frame", "label", "mean_e1", "volume_change"], ""),
    ("strain of regions", &["label", "component", "mean", "mean_sd"], ""),
    ("stiffness of regions", &["label", "name", "youngs_modulus_kpa", "identifiable"], ""),
    ("stiffness of regions by frame", &["frame", "label", "value", "identifiable"], ""),
    ("measured boundary conditions of a mesh", &["node", "ux", "cov_xx", "patch"], ""),
    ("Young's modulus of a mesh's elements", &["element", "label", "youngs_modulus"], ""),
    ("results of a batch", &["name", "status", "stage", "reason"], ""),
    ("stiffness of the regions of a batch", &["name", "region", "youngs_modulus", "unit"], ""),
    ("table of pairs", &["initial", "deformed"], "palpate batch FILE -o BATCH"),
    ("runs of palpate chart", &["part", "varied", "method", "cpu_s"], ""),
    ("runs of palpate stress", &["part", "axis", "severity", "broken"], ""),
    ("errors of palpate demo", &["stage", "quantity", "found", "truth"], ""),
    ("bands of a grasp", &["time", "x_low", "x_high", "theta_low"], ""),
    ("measurements beside tip models", &["d", "tilt_deg", "force", "force_parallel-normal"], ""),
    ("measurements beside tip models", &["time", "theta1_deg", "theta_deg", "theta_deg_parallel"], ""),
    (
        "presses of a fingertip",
        &["d", "tilt_deg", "force"],
        "palpate grasp-analysis SCENE.toml --measured FILE -o analysis",
    ),
    (
        "course of a grasp",
        &["time", "theta1_deg", "theta2_deg", "x", "y", "theta_deg"],
        "palpate grasp-analysis SCENE.toml --measured FILE -o analysis",
    ),
    ("sweep of a grasp", &["case", "outcome", "time"], ""),
    ("stability of a grasp", &["step", "model", "lambda1", "class"], ""),
    ("energy of a grasp", &["step", "model", "axis", "energy"], ""),
    ("motions of a grasp", &["step", "theta1_deg", "dn1", "fn1"], ""),
    ("pinch map of a grasp", &["theta1_deg", "theta2_deg", "state"], ""),
    ("trajectory of a grasp", &["time", "theta", "dn1", "ft1"], ""),
    ("posture force of a grasp", &["d", "tilt_deg", "parallel_n"], ""),
    ("response of skin", &["time", "stress_pa", "displacement_m"], ""),
];

/// What a table with these columns is and a command that takes `FILE`, where palpate knows it.
pub fn table(columns: &[String]) -> Option<(&'static str, &'static str)> {
    let has = |name: &&str| columns.iter().any(|c| c.eq_ignore_ascii_case(name));
    TABLES.iter().find(|known| known.1.iter().all(has)).map(|known| (known.0, known.2))
}
