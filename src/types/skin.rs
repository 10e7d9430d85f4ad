//! Layered skin: rheological elements, a stack of them, and what is done to it. SI units.

use crate::error::{SceneError, UnknownName};
use crate::types::names::choose;
use serde::Serialize;
use std::str::FromStr;

/// A rheological element: `sigma = e0 e + c0 e' + sum_i s_i` with
/// `s_i' = E_i e' - (E_i / c_i) s_i`, a spring and a dashpot beside Maxwell branches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ElementKind {
    /// A spring beside a dashpot; recovers wholly.
    KelvinVoigt,
    /// A spring beside one Maxwell branch (and a dashpot, where given); recovers wholly.
    StandardLinearSolid,
    /// A dashpot beside one Maxwell branch; a deformation stays.
    ThreeElement,
    /// A dashpot beside two Maxwell branches; a deformation stays.
    FiveElement,
}

impl ElementKind {
    /// Names and kinds.
    pub const KNOWN: [(&'static str, Self); 4] = [
        ("kelvin-voigt", Self::KelvinVoigt),
        ("standard-linear-solid", Self::StandardLinearSolid),
        ("three-element", Self::ThreeElement),
        ("five-element", Self::FiveElement),
    ];

    /// Whether there is a spring, and a dashpot, beside the branches (a dashpot is optional in a
    /// standard linear solid); and the number of branches.
    fn parts(self) -> (bool, bool, usize) {
        match self {
            Self::KelvinVoigt => (true, true, 0),
            Self::StandardLinearSolid => (true, false, 1),
            Self::ThreeElement => (false, true, 1),
            Self::FiveElement => (false, true, 2),
        }
    }
}

impl FromStr for ElementKind {
    type Err = UnknownName;

    fn from_str(name: &str) -> Result<Self, UnknownName> {
        choose("element", name, &Self::KNOWN)
    }
}

/// One layer of skin.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Layer {
    /// What it is called.
    pub name: String,
    /// Thickness (m).
    pub thickness: f64,
    /// Its element.
    pub element: ElementKind,
    /// Modulus of the lone spring (Pa), 0 without.
    pub e0: f64,
    /// Coefficient of the lone dashpot (Pa s), 0 without.
    pub c0: f64,
    /// Modulus (Pa) and dashpot (Pa s) of each Maxwell branch.
    pub maxwell: Vec<[f64; 2]>,
    /// Coefficients of all dashpots (Pa s) once the load is off, the lone one first; empty when
    /// they stay (dual moduli: Wang & Hirai 2012).
    pub c_unload: Vec<f64>,
}

impl Layer {
    /// Checks every value.
    ///
    /// # Errors
    /// [`SceneError`] names the first one that is wrong.
    pub fn check(&self) -> Result<(), SceneError> {
        let out = |key: &str, value: f64, range: &'static str| {
            Err(SceneError::Value { key: format!("layer '{}' {key}", self.name), value: value.to_string(), range })
        };
        if !(self.thickness > 0.0 && self.thickness <= 1.0) {
            return out("thickness", self.thickness, "above 0 and at most 1 m");
        }
        let (spring, dashpot, branches) = self.element.parts();
        let optional = self.element == ElementKind::StandardLinearSolid;
        if spring && !(self.e0 > 0.0 && self.e0.is_finite()) {
            return out("e0", self.e0, "above 0 Pa for this element");
        }
        if !spring && self.e0 != 0.0 {
            return out("e0", self.e0, "absent: this element has no lone spring");
        }
        if !(self.c0 > 0.0 && self.c0.is_finite() || self.c0 == 0.0 && (optional || !dashpot)) {
            return out("c0", self.c0, "above 0 Pa s for this element");
        }
        if self.maxwell.len() != branches {
            let range = match branches {
                0 => "absent: this element has no Maxwell branch",
                1 => "one pair [modulus, dashpot] for this element",
                _ => "two pairs [modulus, dashpot] for this element",
            };
            return out("maxwell, number of pairs", self.maxwell.len() as f64, range);
        }
        if let Some(v) = self.maxwell.iter().flatten().find(|v| !(**v > 0.0 && v.is_finite())) {
            return out("maxwell", *v, "pairs of numbers above 0 (Pa, Pa s)");
        }
        let dashpots = usize::from(self.c0 > 0.0) + branches;
        if !self.c_unload.is_empty() && self.c_unload.len() != dashpots {
            let range = "one number for each dashpot, the lone one first";
            return out("c_unload, how many", self.c_unload.len() as f64, range);
        }
        if let Some(v) = self.c_unload.iter().find(|v| !(**v > 0.0 && v.is_finite())) {
            return out("c_unload", *v, "above 0 Pa s");
        }
        Ok(())
    }

    /// The lone dashpot and the branches as they are under load, or once it is off.
    pub fn dashpots(&self, unloaded: bool) -> (f64, Vec<[f64; 2]>) {
        if !unloaded || self.c_unload.is_empty() {
            return (self.c0, self.maxwell.clone());
        }
        let lone = usize::from(self.c0 > 0.0);
        let c0 = if lone == 1 { self.c_unload[0] } else { 0.0 };
        let branches = self.maxwell.iter().zip(&self.c_unload[lone..]);
        (c0, branches.map(|(m, c)| [m[0], *c]).collect())
    }
}

/// Down, held, let go: a ramp of displacement, a hold, then no load.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SkinLoad {
    /// Indentation (m).
    pub displacement: f64,
    /// Seconds down.
    pub ramp: f64,
    /// Seconds held.
    pub hold: f64,
    /// Time of the end (s).
    pub end: f64,
}

/// The block of the finite element model: plane strain, fixed at its base, pressed by a flat punch
/// that sticks.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SkinBlock {
    /// Width (m).
    pub width: f64,
    /// Width of the punch (m).
    pub indenter: f64,
    /// Poisson's ratio of all layers.
    pub poisson: f64,
}

/// A skin scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SkinScene {
    /// What is done.
    pub load: SkinLoad,
    /// From the surface down.
    pub layers: Vec<Layer>,
    /// For the finite element model.
    pub block: SkinBlock,
}

impl SkinScene {
    /// Thickness of all layers (m).
    pub fn thickness(&self) -> f64 {
        self.layers.iter().map(|l| l.thickness).sum()
    }

    /// Checks every value.
    ///
    /// # Errors
    /// [`SceneError`] names the first one that is wrong.
    pub fn check(&self) -> Result<(), SceneError> {
        let SkinLoad { displacement, ramp, hold, end } = self.load;
        let checks = [
            ("load.displacement", displacement, displacement > 0.0, "above 0 m (it is a depth)"),
            ("load.ramp", ramp, ramp > 0.0, "above 0 s"),
            ("load.hold", hold, hold >= 0.0, "0 s or more"),
            ("load.end", end, end > ramp + hold, "after ramp + hold (s)"),
            ("block.width", self.block.width, self.block.width > 0.0, "above 0 m"),
            (
                "block.indenter",
                self.block.indenter,
                self.block.indenter > 0.0 && self.block.indenter <= self.block.width,
                "above 0 m and at most block.width",
            ),
            ("block.poisson", self.block.poisson, (0.0..0.5).contains(&self.block.poisson), "0 to below 0.5"),
        ];
        for (key, value, fine, range) in checks {
            if !(fine && value.is_finite()) {
                return Err(SceneError::Value { key: key.into(), value: value.to_string(), range });
            }
        }
        if self.layers.is_empty() {
            return Err(SceneError::Value {
                key: "layer".into(),
                value: "none".into(),
                range: "at least one [[layer]]",
            });
        }
        self.layers.iter().try_for_each(Layer::check)?;
        if displacement >= self.thickness() {
            let range = "less than the thickness of all layers";
            return Err(SceneError::Value { key: "load.displacement".into(), value: displacement.to_string(), range });
        }
        Ok(())
    }

    /// One layer in place of all: as thick, with the mean compliance of each part; none where the
    /// elements differ.
    pub fn without_layers(&self) -> Option<Self> {
        let first = self.layers.first()?;
        if self.layers.iter().any(|l| l.element != first.element || (l.c0 > 0.0) != (first.c0 > 0.0)) {
            return None;
        }
        let thickness = self.thickness();
        // A part that is zero is zero in all of them.
        let series = |part: &dyn Fn(&Layer) -> f64| match part(first) {
            0.0 => 0.0,
            _ => thickness / self.layers.iter().map(|l| l.thickness / part(l)).sum::<f64>(),
        };
        let branch = |i: usize| [series(&|l| l.maxwell[i][0]), series(&|l| l.maxwell[i][1])];
        let unload = |i: usize| {
            series(&|l| {
                let (c0, branches) = l.dashpots(true);
                let all: Vec<f64> = (c0 > 0.0).then_some(c0).into_iter().chain(branches.iter().map(|b| b[1])).collect();
                all[i]
            })
        };
        let dual = self.layers.iter().any(|l| !l.c_unload.is_empty());
        let dashpots = usize::from(first.c0 > 0.0) + first.maxwell.len();
        let layer = Layer {
            name: "one layer".into(),
            thickness,
            element: first.element,
            e0: series(&|l| l.e0),
            c0: series(&|l| l.c0),
            maxwell: (0..first.maxwell.len()).map(branch).collect(),
            c_unload: if dual { (0..dashpots).map(unload).collect() } else { Vec::new() },
        };
        Some(Self { layers: vec![layer], ..self.clone() })
    }
}

/// The state of a column at one time.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SkinSample {
    /// Time (s).
    pub time: f64,
    /// Stress, pressure positive (Pa).
    pub stress: f64,
    /// Indentation (m).
    pub displacement: f64,
    /// Compression of each layer (1).
    pub strain: Vec<f64>,
    /// Integral of the stress so far (Pa s).
    pub impulse: f64,
}

/// The block at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct BlockShape {
    /// Time (s).
    pub time: f64,
    /// Node places (m): x from the middle of the punch, y up from the base; column by column, from
    /// the base up.
    pub nodes: Vec<[f64; 2]>,
    /// Compression (1) of each cell along y, column by column.
    pub compression: Vec<f64>,
}

/// What the finite element model gives.
#[derive(Debug, Clone, PartialEq)]
pub struct BlockRun {
    /// Cells along x (of the half that is modelled) and y.
    pub cells: [usize; 2],
    /// The layer of each row of cells, from the base up.
    pub layer: Vec<usize>,
    /// Mean pressure under the punch and its depth; strains are means of each layer under the
    /// punch.
    pub samples: Vec<SkinSample>,
    /// At the end of the hold, and at the end.
    pub shapes: Vec<BlockShape>,
}
