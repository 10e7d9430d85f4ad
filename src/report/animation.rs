//! A film of a sequence: sections of every frame with a mesh that moves with the tissue, coloured
//! by its strain.

use crate::error::ReportError;
use crate::report::colormap::ColorMap;
use crate::report::field::Values;
use crate::report::html::{figure, legend};
use crate::report::picture::Picture;
use crate::report::scale::Scale;
use crate::report::section::Section;
use crate::report::statistics::quantile;
use crate::types::{DenseField, Grid, Mask, WorldPoint};
use maud::{Markup, PreEscaped, html};
use serde::Serialize;
use std::fmt::Write;

/// Nodes of the mesh along the longer side of a section.
const NODES_ACROSS: usize = 36;

/// Pictures and meshes of the frames so far.
#[derive(Debug)]
pub(crate) struct Film {
    grid: Grid,
    range: [f64; 2],
    planes: Vec<Plane>,
    frames: Vec<usize>,
}

/// One section of every frame.
#[derive(Debug)]
struct Plane {
    section: Section,
    /// Voxel offsets of the mesh's nodes.
    nodes: Vec<usize>,
    /// Numbers of four nodes around each cell that lies in tissue.
    cells: Vec<[usize; 4]>,
    pictures: Vec<Picture>,
    /// Node places of each frame (mm to the right and down).
    places: Vec<Vec<[f64; 2]>>,
    /// Strain of each frame's cells.
    strain: Vec<Vec<f32>>,
}

impl Film {
    /// Sections through `centre` (mm) of the reference's grid; gray from `range[0]` to `range[1]`.
    pub fn new(grid: &Grid, centre: WorldPoint, mask: Option<&Mask>, range: [f64; 2]) -> Self {
        let plane = |section: Section| {
            let columns = section.columns(NODES_ACROSS).0;
            let rows = columns.first().map_or(0, Vec::len);
            let nodes = columns.concat();
            let inside = |n: &usize| mask.is_none_or(|m| m.as_slice()[nodes[*n]] != 0);
            let around =
                |c: usize, r: usize| [(c - 1) * rows + r - 1, c * rows + r - 1, c * rows + r, (c - 1) * rows + r];
            let all = (1..columns.len()).flat_map(|c| (1..rows).map(move |r| around(c, r)));
            let cells = all.filter(|cell| cell.iter().all(inside)).collect();
            Plane { section, nodes, cells, pictures: vec![], places: vec![], strain: vec![] }
        };
        let planes = Section::through(grid, centre).into_iter().map(plane).collect();
        Self { grid: *grid, range, planes, frames: Vec::new() }
    }

    /// Adds frame `number`: its `image` on the reference's grid, its displacement, the largest
    /// principal strain at a voxel.
    ///
    /// # Errors
    /// [`ReportError`] when a picture cannot be encoded.
    pub fn add(
        &mut self,
        number: usize,
        image: Values<'_>,
        field: &DenseField,
        strain: Values<'_>,
    ) -> Result<(), ReportError> {
        for plane in &mut self.planes {
            plane.pictures.push(Picture::gray(&plane.section, image, self.range)?);
            let place = |&o: &usize| {
                let [i, j, k] = self.grid.voxel(o);
                plane.section.place(self.grid.world(i, j, k).moved(field.at(o).map(f64::from))).0
            };
            plane.places.push(plane.nodes.iter().map(place).collect());
            let mean = |cell: &[usize; 4]| cell.iter().map(|&n| strain(plane.nodes[n])).sum::<f32>() / 4.0;
            plane.strain.push(plane.cells.iter().map(mean).collect());
        }
        self.frames.push(number);
        Ok(())
    }

    /// The player: pictures, mesh and buttons, in the order of the frames' numbers.
    pub(super) fn player(&self, clock: &[String]) -> Markup {
        let mut order: Vec<usize> = (0..self.frames.len()).collect();
        order.sort_by_key(|&at| self.frames[at]);
        let all = self.planes.iter().flat_map(|p| p.strain.iter().flatten()).map(|&v| f64::from(v));
        let scale = Scale::from_zero(quantile(all, 0.99), "", ColorMap::Magma);
        html! {
            div.film {
                div.planes {
                    @for p in &self.planes {
                        (figure(p.section.plane, p.section.size_mm(), html! { canvas {} }))
                    }
                }
                div.controls {
                    button type="button" { "Play" }
                    input type="range" aria-label="Frame" min="0" max=(order.len().saturating_sub(1)) value="0";
                    output {}
                    label { input type="checkbox" name="mesh" checked; " mesh" }
                    label { input type="checkbox" name="strain" checked; " strain" }
                }
                (legend(Some(&scale)))
                script type="application/json" { (PreEscaped(self.data(&order, &scale, clock))) }
            }
            script { (PreEscaped(include_str!("animation.js"))) }
        }
    }

    /// The frames in `order` as JSON, as it is read: values of all nodes and frames would take many
    /// times the room of their text.
    fn data(&self, order: &[usize], scale: &Scale, clock: &[String]) -> String {
        let byte = |v: &f32| (255.0 * scale.position(f64::from(*v)).clamp(0.0, 1.0)).round() as u8;
        let mut out = String::from("{\"planes\":[");
        for (n, plane) in self.planes.iter().enumerate() {
            out.push_str(if n == 0 { "" } else { "," });
            plane.write(&mut out, order, &byte);
        }
        let colours: Vec<String> = (0..=255).map(|i| scale.map.hex(f64::from(i) / 255.0)).collect();
        let names: Vec<&String> = order.iter().filter_map(|&at| clock.get(self.frames[at])).collect();
        let names = text(&names).replace("</", "<\\/");
        let _ = write!(out, "],\"colours\":{},\"clock\":{names}}}", text(&colours));
        out
    }
}

impl Plane {
    /// The frames in `order` as JSON; `byte` gives a strain its colour's number.
    fn write(&self, out: &mut String, order: &[usize], byte: &dyn Fn(&f32) -> u8) {
        let round = |v: f64| (v * 100.0).round() / 100.0;
        let places = |at: usize| self.places[at].iter().map(|q| q.map(round)).collect::<Vec<_>>();
        let strain = |at: usize| self.strain[at].iter().map(byte).collect::<Vec<_>>();
        let _ = write!(out, "{{\"size\":{},\"cells\":{}", text(&self.section.size_mm().map(round)), text(&self.cells));
        let list = |out: &mut String, name: &str, of: &dyn Fn(usize) -> String| {
            let _ = write!(out, ",\"{name}\":[");
            for (n, &at) in order.iter().enumerate() {
                out.push_str(if n == 0 { "" } else { "," });
                out.push_str(&of(at));
            }
            out.push(']');
        };
        list(out, "pictures", &|at| text(&self.pictures[at].data_uri()));
        list(out, "places", &|at| text(&places(at)));
        list(out, "strain", &|at| text(&strain(at)));
        out.push('}');
    }
}

/// As JSON; what cannot be written so is null.
fn text(value: &impl Serialize) -> String {
    serde_json::to_string(value).unwrap_or_else(|_| "null".into())
}
