#!/usr/bin/env python3
"""Elastic bodies with known moduli, solved by an independent finite-element code, as cases for `palpate stiffness`.

    make.py SET [--out DIR] [--kinds A,B] [--seeds 1,2,3] [--fine F]     SET is choose (seeds 1-3) or report (seeds 11-13)
    make.py verify                                                       checks of the solver (see `verify`)

Needs numpy, scipy, nibabel and gmsh; pypardiso makes the solutions about ten times faster.

Each case is a folder DIR/SET/KIND_SEED with labels.nii.gz (or mask.nii.gz and truth_labels.nii.gz), displacement.nii.gz,
load.nii.gz where the patch is given as a mask, and case.json (see `write_case`). All that makes a case (moduli, sizes,
places, voxels, press, tilt) is drawn from its kind and seed.

Solver: curved quadratic tetrahedra fitted to all interfaces (gmsh), displacement quadratic, pressure linear, continuous in
a region and free to jump between regions (Taylor-Hood), so that Poisson's ratios of 0.49 and 0.495 do not lock. Law:
compressible neo-Hookean P = mu (F - F^-T) + lambda ln J F^-T with lambda = 2 mu nu / (1 - 2 nu), or its linear part.

Units: mm, kPa, and so mN for forces; N in case.json. Axes: world RAS, the body stands on z = 0 and is pressed along -z.
"""
import argparse
import json
import sys
import time
from pathlib import Path

import nibabel as nib
import numpy as np
import scipy.ndimage as ndi
import scipy.sparse as sp
import scipy.sparse.linalg

try:
    import pypardiso
except ImportError:
    pypardiso = None

# ---------------------------------------------------------------------------------------------------------------- shapes


class Box:
    """A box from corner lo to corner hi (mm)."""

    def __init__(self, lo, hi):
        self.lo, self.hi = np.array(lo, float), np.array(hi, float)

    def inside(self, x):
        return np.all((x >= self.lo) & (x <= self.hi), axis=-1)

    def distance(self, x):
        """Distance to the box, 0 inside (mm)."""
        return np.linalg.norm(np.maximum(0, np.maximum(self.lo - x, x - self.hi)), axis=-1)

    def occ(self, occ):
        return [(3, occ.addBox(*self.lo, *(self.hi - self.lo)))]


class Ball:
    """A ball, or with three radii an ellipsoid along the axes for voxel labels alone (mm)."""

    def __init__(self, centre, radius):
        self.centre, self.radius = np.array(centre, float), radius

    def inside(self, x):
        return np.linalg.norm((x - self.centre) / self.radius, axis=-1) <= 1

    def distance(self, x):
        """Distance to the sphere (mm)."""
        return np.abs(np.linalg.norm(x - self.centre, axis=-1) - self.radius)

    def occ(self, occ):
        return [(3, occ.addSphere(*self.centre, self.radius))]


class Rod:
    """A lying cylinder along x through (0, 0, height), of a radius and half a length (mm)."""

    def __init__(self, height, radius, half):
        self.height, self.radius, self.half = height, radius, half

    def inside(self, x):
        return (np.hypot(x[..., 1], x[..., 2] - self.height) <= self.radius) & (np.abs(x[..., 0]) <= self.half)

    def distance(self, x):
        """Distance to the round face (mm)."""
        return np.abs(np.hypot(x[..., 1], x[..., 2] - self.height) - self.radius)

    def occ(self, occ):
        return [(3, occ.addCylinder(-self.half, 0, self.height, 2 * self.half, 0, 0, self.radius))]


class Both:
    """What two shapes share."""

    def __init__(self, a, b):
        self.a, self.b = a, b

    def inside(self, x):
        return self.a.inside(x) & self.b.inside(x)

    def occ(self, occ):
        return occ.intersect(self.a.occ(occ), self.b.occ(occ))[0]


class Disc:
    """A horizontal disc; its rim becomes edges of the mesh (mm)."""

    def __init__(self, centre, radius):
        self.centre, self.radius = np.array(centre, float), radius

    def inside(self, x):
        return np.hypot(x[..., 0] - self.centre[0], x[..., 1] - self.centre[1]) <= self.radius + 1e-6

    def distance(self, x):
        """Distance to the rim (mm)."""
        rho = np.hypot(x[..., 0] - self.centre[0], x[..., 1] - self.centre[1])
        return np.hypot(rho - self.radius, x[..., 2] - self.centre[2])

    def occ(self, occ):
        return [(2, occ.addDisk(*self.centre, self.radius, self.radius))]


class Strip:
    """A horizontal strip |x - x0| < half at a height, as long as the body (mm)."""

    def __init__(self, x0, height, half, length):
        self.x0, self.height, self.half, self.length = x0, height, half, length

    def inside(self, x):
        return np.abs(x[..., 0] - self.x0) <= self.half + 1e-6

    def distance(self, x):
        """Distance to the two long edges (mm)."""
        return np.hypot(np.abs(x[..., 0] - self.x0) - self.half, x[..., 2] - self.height)

    def occ(self, occ):
        return [(2, occ.addRectangle(self.x0 - self.half, -self.length / 2, self.height, 2 * self.half, self.length))]


class Body:
    """A base shape (label 1) and parts in it: (label, shape), later ones over earlier ones; label None only cuts the mesh.

    `sizes` are (distance function, element size there in mm); elements grow away from there up to `size`."""

    def __init__(self, base, parts=(), size=3.2, sizes=()):
        self.base, self.parts, self.size, self.sizes = base, list(parts), size, list(sizes)

    def label_at(self, x):
        """Labels at points (n, 3), 0 outside."""
        label = self.base.inside(x).astype(int)
        for number, shape in self.parts:
            if number is not None:
                label[shape.inside(x) & (label > 0)] = number
        return label

    def size_at(self, x):
        """Size of elements wanted at a point (mm)."""
        return min([self.size] + [small + 0.4 * float(distance(x)) for distance, small in self.sizes])


# ------------------------------------------------------------------------------------------------------------------ mesh


class Mesh:
    """Ten-node tetrahedra: `x` (n, 3) mm, `tets` (m, 10), `label` (m,)."""

    def __init__(self, x, tets, label):
        self.x, self.tets, self.label = x, tets, label

    def geometry(self, points):
        """Gradients of the shape functions (m, q, 10, 3) in 1/mm and the map's determinants (m, q) at reference points."""
        slope = shape_slopes(points)
        jacobian = np.einsum("eai,qaj->eqij", self.x[self.tets], slope)
        return np.einsum("qaj,eqji->eqai", slope, np.linalg.inv(jacobian)), np.linalg.det(jacobian)


EDGES = [(0, 1), (1, 2), (0, 2), (0, 3), (2, 3), (1, 3)]


def shape_values(points):
    """Quadratic shape functions (q, 10) at reference points (q, 3); corners first, then the edges of EDGES."""
    b = np.column_stack([1 - points.sum(axis=1), points])
    return np.column_stack([b * (2 * b - 1)] + [4 * b[:, i] * b[:, j] for i, j in EDGES])


def shape_slopes(points):
    """Their derivatives (q, 10, 3) along the reference axes."""
    b = np.column_stack([1 - points.sum(axis=1), points])
    db = np.vstack([-np.ones(3), np.eye(3)])
    corner = (4 * b - 1)[:, :, None] * db
    edge = np.stack([4 * (b[:, i, None] * db[j] + b[:, j, None] * db[i]) for i, j in EDGES], axis=1)
    return np.concatenate([corner, edge], axis=1)


def quadrature():
    """Eight points in the tetrahedron, exact to degree 3: places (8, 3) and weights (8,), which add up to 1/6."""
    points, weights = [], []
    for a, w in ((0.32805469671142664734, 0.13852796651186214232), (0.10695227393293068277, 0.11147203348813785768)):
        for corner in range(4):
            b = np.full(4, a)
            b[corner] = 1 - 3 * a
            points.append(b[1:])
            weights.append(w / 6)
    return np.array(points), np.array(weights)


def make_mesh(body, fine=1.0):
    """The body's mesh by gmsh, every interface on faces of elements; `fine` divides all sizes."""
    import gmsh

    gmsh.initialize()
    try:
        for option, value in (("General.Terminal", 0), ("General.NumThreads", 1), ("Mesh.MeshSizeExtendFromBoundary", 0),
                              ("Mesh.MeshSizeFromPoints", 0), ("Mesh.Algorithm3D", 1), ("Mesh.SecondOrderLinear", 0)):
            gmsh.option.setNumber(option, value)
        occ = gmsh.model.occ
        base = body.base.occ(occ)
        tools = []
        for _, shape in body.parts:
            made = shape.occ(occ)
            tools += made if made[0][0] == 2 else occ.intersect(occ.copy(base), made)[0]
        if tools:
            occ.fragment(base, tools)
        occ.synchronize()
        gmsh.model.mesh.setSizeCallback(lambda dim, tag, x, y, z, lc: body.size_at(np.array([x, y, z])) / fine)
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(2)
        tags, coordinates, _ = gmsh.model.mesh.getNodes()
        tets = np.array(gmsh.model.mesh.getElementsByType(11)[1], int).reshape(-1, 10)
    finally:
        gmsh.finalize()
    place = np.zeros(int(tags.max()) + 1, int)
    place[tags.astype(int)] = np.arange(len(tags))
    x, tets = coordinates.reshape(-1, 3), place[tets]
    used, tets = np.unique(tets, return_inverse=True)
    x, tets = x[used], tets.reshape(-1, 10)
    mesh = Mesh(x, tets, body.label_at(x[tets[:, :4]].mean(axis=1)))
    straighten(mesh)
    if (mesh.label == 0).any():
        raise ValueError("an element's middle lies outside the body")
    return mesh


def straighten(mesh):
    """Elements that their curved edges turn inside out get straight edges."""
    points = np.vstack([quadrature()[0], np.zeros(3), np.eye(3)])
    for _ in range(5):
        bad = (mesh.geometry(points)[1] <= 0).any(axis=1)
        if not bad.any():
            return
        for k, (i, j) in enumerate(EDGES):
            mesh.x[mesh.tets[bad, 4 + k]] = mesh.x[mesh.tets[bad][:, [i, j]]].mean(axis=1)
    raise ValueError("elements of the mesh are inside out")


def boundary(mesh):
    """Faces of one element: their nodes (f, 6), corners first, then the edges between 01, 12 and 02."""
    faces = []
    for i, j, k in ((0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3)):
        edge = [4 + EDGES.index(tuple(sorted(pair))) for pair in ((i, j), (j, k), (i, k))]
        faces.append(mesh.tets[:, [i, j, k] + edge])
    faces = np.concatenate(faces)
    _, first, count = np.unique(np.sort(faces[:, :3], axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]]


def pressed(mesh, height, pressure):
    """Nodal forces (n, 3) in mN of a downward pressure(x) in kPa on the flat face at a height; seven points a face."""
    faces = boundary(mesh)
    faces = faces[(np.abs(mesh.x[faces][:, :, 2] - height) < 1e-6).all(axis=1)]
    a, b, r = 0.059715871789770, 0.470142064105115, 0.797426985353087
    s = 0.101286507323456
    bary = np.array([[1 / 3] * 3, [a, b, b], [b, a, b], [b, b, a], [r, s, s], [s, r, s], [s, s, r]])
    weight = np.array([0.225] + [0.132394152788506] * 3 + [0.125939180544827] * 3) / 2
    value = np.column_stack([bary * (2 * bary - 1)] + [4 * bary[:, i] * bary[:, j] for i, j in ((0, 1), (1, 2), (0, 2))])
    corner = mesh.x[faces[:, :3]]
    double = np.abs(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])[:, 2])
    place = np.einsum("qa,fai->fqi", value, mesh.x[faces])
    share = np.einsum("fq,q,f,qa->fa", pressure(place), weight, double, value)
    force = np.zeros_like(mesh.x)
    np.add.at(force[:, 2], faces, -share)
    return force


# ---------------------------------------------------------------------------------------------------------------- solver


class System:
    """The mixed system of a mesh with moduli, for one set of prescribed components `fixed` (n, 3)."""

    def __init__(self, mesh, mu, lam, fixed):
        """mu and lam in kPa: one an element (m,) or one a quadrature point (m, 8)."""
        self.mesh = mesh
        points, weights = quadrature()
        self.slope, jacobian = mesh.geometry(points)
        self.weight = jacobian * weights
        spread = np.ones((1, len(weights)))
        self.mu, self.lam = (np.asarray(v, float).reshape(len(mesh.tets), -1) * spread for v in (mu, lam))
        self.linear = np.column_stack([1 - points.sum(axis=1), points])
        pairs = np.stack([np.repeat(mesh.label, 4), mesh.tets[:, :4].ravel()], axis=1)
        kinds, inverse = np.unique(pairs, axis=0, return_inverse=True)
        self.nu, self.np = 3 * len(mesh.x), len(kinds)
        moves = (3 * mesh.tets[:, :, None] + np.arange(3)).reshape(-1, 30)
        self.dofs = np.hstack([moves, self.nu + inverse.reshape(-1, 4)])
        self.free = np.concatenate([~fixed.ravel(), np.ones(self.np, bool)])
        self._pattern()
        self.solver = pypardiso.PyPardisoSolver(mtype=-2) if pypardiso else None

    def _pattern(self):
        """Where entries of element matrices go in the upper triangle of the matrix of the free unknowns."""
        number = np.where(self.free, np.cumsum(self.free) - 1, -1)[self.dofs]
        rows, columns = np.broadcast_arrays(number[:, :, None], number[:, None, :])
        self.keep = np.flatnonzero(((rows >= 0) & (columns >= rows)).ravel())
        size = int(self.free.sum())
        key = rows.ravel()[self.keep].astype(np.int64) * size + columns.ravel()[self.keep]
        key, self.entry = np.unique(key, return_inverse=True)
        self.columns = (key % size).astype(np.int32)
        self.starts = np.searchsorted(key // size, np.arange(size + 1)).astype(np.int32)

    def evaluate(self, u, p, large, tangent=True):
        """Residual of all unknowns in mN (and mm^3), element tangents (m, 34, 34); None where an element is inside out."""
        gradient = np.einsum("eak,eqai->eqki", u[self.mesh.tets], self.slope, optimize=True)
        pressure = p[self.dofs[:, 30:] - self.nu] @ self.linear.T
        if large:
            f = gradient + np.eye(3)
            j = np.linalg.det(f)
            if (j <= 0).any():
                return None
            inverse = np.linalg.inv(f)
            twist = np.swapaxes(inverse, 2, 3)
            stress = self.mu[..., None, None] * (f - twist) + pressure[..., None, None] * twist
            volume = np.log(j)
            turned = self.slope @ inverse
            second = self.mu - pressure
        else:
            stress = self.mu[..., None, None] * (gradient + np.swapaxes(gradient, 2, 3)) + pressure[..., None, None] * np.eye(3)
            volume = np.trace(gradient, axis1=2, axis2=3)
            turned, second = self.slope, self.mu
        w = self.weight
        force = np.einsum("eq,eqki,eqai->eak", w, stress, self.slope, optimize=True).reshape(-1, 30)
        flow = (w * (volume - pressure / self.lam)) @ self.linear
        residual = np.bincount(self.dofs.ravel(), np.hstack([force, flow]).ravel(), minlength=self.nu + self.np)
        if not tangent:
            return residual, None
        m, q = w.shape
        flat = turned.reshape(m, q, 30)
        cross = np.swapaxes(flat * (w * second)[..., None], 1, 2) @ flat
        block = cross.reshape(m, 10, 3, 10, 3).transpose(0, 1, 4, 3, 2).copy()
        plain = np.einsum("eq,eqai,eqbi->eab", w * self.mu, self.slope, self.slope, optimize=True)
        for i in range(3):
            block[:, :, i, :, i] += plain
        matrix = np.empty((m, 34, 34))
        matrix[:, :30, :30] = block.reshape(m, 30, 30)
        mixed = np.swapaxes(flat * w[..., None], 1, 2) @ self.linear
        matrix[:, :30, 30:], matrix[:, 30:, :30] = mixed, np.swapaxes(mixed, 1, 2)
        matrix[:, 30:, 30:] = -np.einsum("eq,qa,qb->eab", w / self.lam, self.linear, self.linear, optimize=True)
        return residual, matrix

    def solve(self, matrices, right):
        """Solution for the free unknowns."""
        values = np.bincount(self.entry, matrices.ravel()[self.keep], minlength=len(self.columns))
        upper = sp.csr_matrix((values, self.columns, self.starts), shape=(len(self.starts) - 1,) * 2)
        if self.solver:
            return self.solver.solve(upper, right)
        full = upper + sp.triu(upper, 1).T
        return sp.linalg.splu(full.tocsc()).solve(right)


def solve(mesh, mu, lam, fixed, value, load=None, large=True, steps=1):
    """Equilibrium with components `fixed` (n, 3) prescribed as `value` (mm) and nodal forces `load` (mN).

    Loads are raised in `steps`, and in more where that finds no equilibrium. Returns the displacement (n, 3) in mm and the
    reaction (n, 3) in mN (0 where nothing is prescribed)."""
    system = System(mesh, mu, lam, fixed)
    while True:
        try:
            return follow(system, fixed, value, np.zeros_like(mesh.x) if load is None else load, large, steps)
        except ValueError:
            if not large or steps > 8:
                raise
            steps *= 2


def follow(system, fixed, value, load, large, steps):
    """Newton's method along a load raised in `steps`; as `solve`."""
    mesh = system.mesh
    u, p = np.zeros_like(mesh.x), np.zeros(system.np)
    if not large:
        steps = 1
    for step in range(1, steps + 1):
        part = step / steps
        jump = np.zeros(system.nu + system.np)
        jump[: system.nu] = np.where(fixed, part * value - u, 0).ravel()
        outer = np.concatenate([part * load.ravel(), np.zeros(system.np)])
        for iteration in range(20):
            residual, matrices = system.evaluate(u, p, large)
            moved = (matrices @ jump[system.dofs][:, :, None])[:, :, 0]
            pulled = np.bincount(system.dofs.ravel(), moved.ravel(), minlength=len(jump)) if jump.any() else 0
            change = jump.copy()
            change[system.free] = system.solve(matrices, (outer - residual - pulled)[system.free])
            length, tried = 1.0, None
            while tried is None and length > 1e-3:
                new_u = u + length * change[: system.nu].reshape(-1, 3)
                new_p = p + length * change[system.nu:]
                tried = system.evaluate(new_u, new_p, large, tangent=False)
                length /= 2
            if tried is None:
                raise ValueError("no equilibrium found: elements turn inside out")
            u, p = new_u, new_p
            jump[: system.nu] = np.where(fixed, part * value - u, 0).ravel()
            scale = np.abs(tried[0][: system.nu]).max()
            error = np.abs((outer - tried[0])[system.free]).max()
            if not large or (error < 1e-6 * scale and np.abs(jump).max() < 1e-12):
                break
        else:
            raise ValueError("no equilibrium found in 20 steps of Newton's method")
    inner = tried[0][: system.nu].reshape(-1, 3)
    return u, np.where(fixed, inner - load, 0)


def lame(young, poisson):
    """Lame's constants mu and lambda (kPa)."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def by_label(mesh, table):
    """A number for each element (m,) from {label: number}."""
    return np.vectorize(table.get, otypes=[float])(mesh.label)


# ---------------------------------------------------------------------------------------------------------------- voxels


class Grid:
    """A grid of voxels: shape, spacing (mm), place of the first centre (mm); array axes along world axes."""

    def __init__(self, lo, hi, spacing, shift, margin=3):
        """Covers lo to hi and `margin` voxels around; `shift` (0 to 1) moves it by parts of a voxel."""
        self.spacing = np.array(spacing, float)
        lo, hi = np.array(lo, float), np.array(hi, float)
        self.first = lo - (margin - np.array(shift)) * self.spacing
        self.shape = tuple(np.ceil((hi - self.first) / self.spacing).astype(int) + margin)

    def centres(self):
        """Centres of all voxels (nx, ny, nz, 3) in mm."""
        return np.stack(np.meshgrid(*[self.first[i] + self.spacing[i] * np.arange(self.shape[i]) for i in range(3)],
                                    indexing="ij"), axis=-1)


def sample(mesh, u, grid, wanted):
    """The solution at the centres of the wanted voxels: u's own polynomial in the element that holds each; 0 elsewhere."""
    corners = mesh.x[mesh.tets]
    pad = 0.02 * np.ptp(corners, axis=1)
    lo = np.ceil((corners.min(axis=1) - pad - grid.first) / grid.spacing).astype(int)
    hi = np.floor((corners.max(axis=1) + pad - grid.first) / grid.spacing).astype(int)
    lo, hi = np.maximum(lo, 0), np.minimum(hi, np.array(grid.shape) - 1)
    count = np.maximum(hi - lo + 1, 0)
    total = count.prod(axis=1)
    element = np.repeat(np.arange(len(total)), total)
    running = np.arange(total.sum()) - np.repeat(np.cumsum(total) - total, total)
    c = count[element]
    index = np.stack([running // (c[:, 1] * c[:, 2]), running // c[:, 2] % c[:, 1], running % c[:, 2]], axis=1) + lo[element]
    flat = np.ravel_multi_index(index.T, grid.shape)
    ask = wanted.ravel()[flat]
    element, flat, place = element[ask], flat[ask], grid.first + index[ask] * grid.spacing
    local = invert(corners[element], place)
    depth = np.minimum(local.min(axis=1), 1 - local.sum(axis=1))
    depth[~np.isfinite(depth)] = -np.inf
    order = np.lexsort((-depth, flat))
    best = order[np.unique(flat[order], return_index=True)[1]]
    if len(best) < wanted.sum() or depth[best].min() < -0.05:
        raise ValueError("voxels inside the body lie in no element")
    field = np.zeros(grid.shape + (3,))
    field.reshape(-1, 3)[flat[best]] = np.einsum("pa,pai->pi", shape_values(local[best]), u[mesh.tets[element[best]]])
    return field


def invert(nodes, place):
    """Reference places (p, 3) of places (p, 3) in elements with nodes (p, 10, 3), by Newton's method."""
    edge = np.swapaxes(nodes[:, 1:4] - nodes[:, :1], 1, 2)
    local = np.linalg.solve(edge, (place - nodes[:, 0])[:, :, None])[:, :, 0]
    curved = np.abs(nodes[:, 4:] - np.stack([(nodes[:, i] + nodes[:, j]) / 2 for i, j in EDGES], axis=1)).max(axis=(1, 2)) > 1e-9
    near = np.flatnonzero(curved & (np.minimum(local.min(axis=1), 1 - local.sum(axis=1)) > -0.5))
    x = local[near]
    for _ in range(6):
        off = place[near] - np.einsum("pa,pai->pi", shape_values(x), nodes[near])
        jacobian = np.einsum("pai,paj->pij", nodes[near], shape_slopes(x))
        jacobian += 1e-12 * np.eye(3)
        x = np.clip(x + np.linalg.solve(jacobian, off[:, :, None])[:, :, 0], -1, 2)
    local[near] = x
    return local


# ----------------------------------------------------------------------------------------------------------------- cases


class Case:
    """One case while it is made: what is drawn for every kind, and what is written at the end."""

    def __init__(self, kind, seed, fine):
        self.kind, self.seed, self.fine = kind, seed, fine
        self.rng = np.random.default_rng([list(KINDS).index(kind), seed, 57])
        self.size = np.array([self.draw(34, 44), self.draw(34, 44), self.draw(24, 33)])
        spacing = self.draw(0.85, 1.15) * np.ones(3)
        if self.rng.random() < 0.5:
            spacing = np.array([self.draw(0.8, 1.2) for _ in range(3)])
        self.spacing, self.shift = spacing, self.rng.random(3)
        self.flip = self.rng.random(2) < 0.3
        self.nu, self.args, self.extra, self.masks, self.noise = 0.49, [], {}, {}, None
        self.voxel_body, self.named = None, True

    def draw(self, low, high, logarithmic=False):
        """A number between two, by default uniform."""
        if logarithmic:
            return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))
        return float(self.rng.uniform(low, high))

    def top(self, x, slack=1e-6):
        """Nodes on the top face."""
        return np.abs(x[:, 2] - self.size[2]) < slack

    def block(self):
        """The block that the drawn size says, standing on z = 0."""
        half = self.size / 2
        return Box([-half[0], -half[1], 0], [half[0], half[1], self.size[2]])

    def ball(self, label=2, radius=None, low=6.0, high=9.0, room=2.5):
        """A ball somewhere in the block, `room` mm from its surface: (label, Ball)."""
        radius = radius or self.draw(low, min(high, self.size[2] / 2 - room))
        reach = np.maximum(self.size / 2 - radius - room, 0)
        centre = self.rng.uniform(-reach, reach) * [0.8, 0.8, 1.0] + [0, 0, self.size[2] / 2]
        return label, Ball(centre, radius)


def ball_sizes(parts):
    """Small elements at balls."""
    return [(shape.distance, min(2.2, shape.radius / 3.0)) for _, shape in parts if isinstance(shape, Ball)]


def slab_sizes(parts):
    """Small elements in thin layers."""
    return [(shape.distance, min(3.4, max(1.7, 0.8 * (shape.hi - shape.lo)[2]))) for _, shape in parts if isinstance(shape, Box)]


def held(mesh, sticking=True):
    """Prescribed components of a body that stands on z = 0, sticking or sliding; a sliding one is kept from drifting."""
    fixed = np.zeros(mesh.x.shape, bool)
    base = np.abs(mesh.x[:, 2]) < 1e-6
    fixed[base] = [sticking, sticking, True]
    if not sticking:
        nodes = np.flatnonzero(base)
        middle = nodes[np.argmin(np.linalg.norm(mesh.x[nodes, :2], axis=1))]
        far = nodes[np.argmax(mesh.x[nodes, 0] - np.abs(mesh.x[nodes, 1] - mesh.x[middle, 1]))]
        fixed[middle, :2] = True
        fixed[far, 1] = True
    return fixed, np.zeros_like(mesh.x)


def plate(mesh, fixed, value, nodes, depth, tilt=(0.0, 0.0), sticking=True):
    """Adds a rigid plate that moves down by `depth` (mm) and turns by `tilt` (radians about x and y)."""
    centre = (mesh.x[nodes].min(axis=0) + mesh.x[nodes].max(axis=0)) / 2
    a, b = tilt
    turn = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    turn = turn @ np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    motion = (mesh.x[nodes] - centre) @ (turn - np.eye(3)).T - [0, 0, depth]
    fixed[nodes] = fixed[nodes] | np.array([sticking, sticking, True])
    value[nodes] = np.where([sticking, sticking, True], motion, value[nodes])


def press(case, body, young, depth, sticking=None, tilted=True, large=True, steps=1, nu=None, modulus=None):
    """Solves a body between two plates over its whole faces; draws sticking or sliding, and a tilt. Sets the force.

    `young` and `nu` are {label: value}; `modulus` (x -> kPa) replaces young within label 1."""
    sticking = bool(case.rng.random() < 0.7) if sticking is None else sticking
    tilt = case.rng.uniform(-0.02, 0.02, 2) if tilted else (0.0, 0.0)
    mesh = make_mesh(body, case.fine)
    fixed, value = held(mesh, sticking)
    plate(mesh, fixed, value, case.top(mesh.x), depth, tilt, sticking)
    e = by_label(mesh, young)[:, None] * np.ones((1, 8))
    if modulus is not None:
        places = np.einsum("qa,eai->eqi", shape_values(quadrature()[0]), mesh.x[mesh.tets])
        inside = mesh.label == 1
        e[inside] = modulus(places[inside])
    mu, lam = lame(e, by_label(mesh, nu or {label: case.nu for label in young})[:, None])
    u, reaction = solve(mesh, mu, lam, fixed, value, large=large, steps=steps)
    case.contact = "sticking" if sticking else "sliding"
    return finish(case, body, mesh, u, reaction, case.top(mesh.x), young)


def finish(case, body, mesh, u, reaction, loaded, young):
    """Keeps solution, force on the loaded nodes (N) and true moduli for `write_case`."""
    case.body, case.mesh, case.u = body, mesh, u
    case.force = float(np.linalg.norm(reaction[loaded].sum(axis=0))) / 1000
    case.balance = float(np.linalg.norm(reaction.sum(axis=0))) / 1000
    case.truth = dict(young)
    return case


def voxels(case):
    """Grid, true labels and displacement (mm, RAS) of a solved case."""
    lo, hi = case.mesh.x.min(axis=0), case.mesh.x.max(axis=0)
    if "crop" in case.extra:
        lo[0], hi[0] = -case.extra["crop"], case.extra["crop"]
    grid = Grid(lo, hi, case.spacing, case.shift, case.extra.get("margin", 3))
    if "crop" in case.extra:
        count = int(2 * case.extra["crop"] / grid.spacing[0])
        grid.first[0], grid.shape = -(count - 1) / 2 * grid.spacing[0], (count,) + grid.shape[1:]
    centres = grid.centres()
    labels = case.body.label_at(centres.reshape(-1, 3)).reshape(grid.shape)
    return grid, centres, labels, sample(case.mesh, case.u, grid, labels > 0)


def with_noise(case, field, inside):
    """Adds the case's noise (sd in mm, smoothing in voxels) to the field inside the body."""
    sd, smooth = case.noise
    noise = case.rng.standard_normal(field.shape)
    if smooth:
        noise = np.stack([ndi.gaussian_filter(noise[..., i], smooth / 2.355) for i in range(3)], axis=-1)
        noise /= noise.std()
    return np.where(inside[..., None], field + sd * noise, 0)


def write_volume(case, path, data, grid):
    """Writes a volume (labels) or field (LPS mm) with the case's flips of the first two array axes."""
    affine = np.diag([*grid.spacing, 1.0])
    affine[:3, 3] = grid.first
    for axis in range(2):
        if case.flip[axis]:
            data = np.flip(data, axis)
            affine[axis, 3] += affine[axis, axis] * (data.shape[axis] - 1)
            affine[axis, axis] *= -1
    vector = data.ndim == 4
    if vector:
        data = (data * [-1, -1, 1])[:, :, :, None, :]
    image = nib.Nifti1Image(data.astype(np.float32 if vector else np.uint8), affine)
    image.header.set_xyzt_units("mm")
    if vector:
        image.header.set_intent("vector")
    nib.save(image, path)


def top_mask(labels, centres, shape):
    """The uppermost voxel of each column of the body whose centre lies in a shape (looked at from above)."""
    body = labels > 0
    above = np.zeros_like(body)
    above[:, :, :-1] = body[:, :, 1:]
    return body & ~above & shape.inside(centres)


def write_case(case, folder):
    """Writes the files of a case. case.json: kind, seed, args (arguments of palpate stiffness but for field, labels or mask
    and output; paths within the folder), truth {label: kPa}, labelled, note, force_n, poisson {label: nu}, contact, voxel_mm, size_mm,
    strain_p95 (largest principal Green-Lagrange strain), and flags: smooth, wrong_labels, expect."""
    folder.mkdir(parents=True, exist_ok=True)
    grid, centres, labels, field = voxels(case)
    clean = field
    if "affine" in case.extra:
        field = affine_fit(centres, field, labels > 0)
    if case.noise:
        field = with_noise(case, field, labels > 0)
    shown = labels
    if case.voxel_body is not None:
        shown = case.voxel_body(labels, centres, grid)
    if case.named:
        write_volume(case, folder / "labels.nii.gz", shown, grid)
    else:
        write_volume(case, folder / "mask.nii.gz", (labels > 0).astype(int), grid)
        write_volume(case, folder / "truth_labels.nii.gz", labels, grid)
    for name, shape in case.masks.items():
        write_volume(case, folder / f"{name}.nii.gz", top_mask(labels, centres, shape), grid)
    write_volume(case, folder / "displacement.nii.gz", field, grid)
    args = ["--held", "z-", "--load", "load.nii.gz" if "load" in case.masks else "z+"]
    if case.kind != "no_force":
        args += ["--force", f"{case.force:.6g}"]
    args += ["--poisson", f"{case.nu:g}"] + case.args
    about = {"kind": case.kind, "seed": case.seed, "args": args, "truth": {str(k): v for k, v in case.truth.items()},
             "labelled": case.named, "note": case.note, "force_n": case.force, "contact": case.contact,
             "voxel_mm": [round(float(v), 4) for v in grid.spacing], "size_mm": [round(float(v), 3) for v in case.size],
             "elements": len(case.mesh.tets), "nodes": len(case.mesh.x), "unbalanced_n": case.balance,
             "strain_p95": strain_p95(case)}
    about.update({k: v for k, v in case.extra.items() if k in ("smooth", "wrong_labels", "expect", "poisson")})
    (folder / "case.json").write_text(json.dumps(about, indent=1) + "\n")
    return clean


def strain_p95(case):
    """95th percentile, by volume, of the largest absolute principal strain (Green-Lagrange)."""
    slope, jacobian = case.mesh.geometry(np.full((1, 3), 0.25))
    f = np.einsum("eak,eqai->eqki", case.u[case.mesh.tets], slope)[:, 0] + np.eye(3)
    strain = np.abs(np.linalg.eigvalsh((np.swapaxes(f, 1, 2) @ f - np.eye(3)) / 2)).max(axis=1)
    order = np.argsort(strain)
    share = np.cumsum(jacobian[order, 0])
    return float(strain[order][np.searchsorted(share, 0.95 * share[-1])])


def affine_fit(centres, field, inside):
    """The affine field nearest to a field in the body (least squares)."""
    a = np.column_stack([centres[inside], np.ones(inside.sum())])
    fitted = np.zeros_like(field)
    fitted[inside] = a @ np.linalg.lstsq(a, field[inside], rcond=None)[0]
    return fitted


# ----------------------------------------------------------------------------------------------------------------- kinds


def indent(case, noise=None):
    """Skin, fat and muscle under a rounded rigid indenter that sticks to what it touches.

    The radius of the contact and the depth are drawn; the indenter's own radius is then the one for which the pressure
    ends at zero at the rim of the contact (found with the linear law from two solutions at once)."""
    half, height = case.size / 2, case.size[2]
    skin = case.draw(2, 3)
    fat = case.draw(4, 9)
    young = {1: case.draw(25, 60), 2: case.draw(12, 30), 3: case.draw(50, 120)}
    depth = case.draw(1.0, 2.0)
    radius = case.draw(6, 10)
    ball = case.rng.random() < 0.5
    x0, y0 = case.rng.uniform(-4, 4, 2)
    touch = Disc([x0, y0, height], radius) if ball else Strip(x0, height, 0.75 * radius, 2 * half[1])
    parts = [(2, Box([-half[0], -half[1], height - skin - fat], [half[0], half[1], height - skin])),
             (3, Box([-half[0], -half[1], height - skin], [half[0], half[1], height])), (None, touch)]
    body = Body(case.block(), parts, 3.8, slab_sizes(parts) + [(touch.distance, 0.9)])
    mesh = make_mesh(body, case.fine)
    nodes = case.top(mesh.x) & touch.inside(mesh.x)
    offset = mesh.x[nodes] - [x0, y0, 0]
    away = (offset[:, :2] ** 2).sum(axis=1) if ball else offset[:, 0] ** 2
    mu, lam = lame(by_label(mesh, young), case.nu)
    fixed, value = held(mesh)
    fixed[nodes] = True
    rim = nodes & (touch.distance(mesh.x) < 1e-6)
    edge = []
    for shape in (-np.ones(len(away)), away / away.max()):
        value[nodes, 2] = shape
        edge.append(solve(mesh, mu, lam, fixed, value, large=False)[1][rim, 2].sum())
    value[nodes, 2] = depth * (-1 - edge[0] / edge[1] * away / away.max())
    u, reaction = solve(mesh, mu, lam, fixed, value, steps=1)
    finish(case, body, mesh, u, reaction, nodes, young)
    case.contact, case.masks, case.noise = "sticking", {"load": touch}, noise
    own = away.max() / (2 * depth * -edge[0] / edge[1])
    case.note = f"layers under a {'ball' if ball else 'cylinder'} of {own:.0f} mm radius, pressed in {depth:.2f} mm"


def one_ball(case, grow=0.0):
    """A stiff ball between plates; its label `grow` voxels too large all round."""
    parts = [case.ball()]
    young = {1: case.draw(15, 28), 2: case.draw(60, 150)}
    press(case, Body(case.block(), parts, 3.2, ball_sizes(parts)), young, case.draw(0.03, 0.09) * case.size[2])
    case.note = f"ball of {parts[0][1].radius:.1f} mm between {case.contact} plates"
    if grow:
        case.voxel_body = lambda labels, centres, grid: redrawn(labels, centres, grid, parts, [grow])
        case.note += f", its label {abs(grow):g} voxel too {'large' if grow > 0 else 'small'} all round"


def redrawn(labels, centres, grid, balls, grown):
    """Labels with each ball's radius off by a number of voxels (along each axis its own)."""
    new = np.where(labels > 0, 1, 0)
    for (label, ball), grow in zip(balls, grown):
        new[Ball(ball.centre, ball.radius + grow * grid.spacing).inside(centres) & (labels > 0)] = label
    return new


def apart(case, radii, room=2.0, gap=2.0):
    """Balls of the radii that keep `gap` mm between them: [(label, Ball)]."""
    for _ in range(20000):
        balls = [case.ball(label, radius, room=room) for label, radius in enumerate(radii, 2)]
        far = [np.linalg.norm(a.centre - b.centre) - a.radius - b.radius
               for i, (_, a) in enumerate(balls) for _, b in balls[:i]]
        if min(far) > gap:
            return balls
    raise ValueError("balls do not fit")


def three_balls(case):
    """Balls of 10, 60 and 200 kPa, labels off by 0.15 to 0.5 voxel in radius."""
    case.size[:2] = np.maximum(case.size[:2], 38)
    parts = apart(case, [case.draw(4.5, 6.5) for _ in range(3)])
    young = {1: case.draw(17, 24), 2: case.draw(8, 12), 3: case.draw(48, 75), 4: case.draw(150, 250)}
    press(case, Body(case.block(), parts, 3.2, ball_sizes(parts)), young, case.draw(0.03, 0.08) * case.size[2])
    off = case.rng.uniform(0.15, 0.5, 3) * case.rng.choice([-1, 1], 3)
    case.voxel_body = lambda labels, centres, grid: redrawn(labels, centres, grid, parts, off)
    told = ", ".join(f"{v:+.2f}" for v in off)
    case.note = f"three balls, {case.contact} plates, radii of the labels off by {told} voxels"


def three_unlabelled(case):
    """Balls of contrast 0.5, 3 and 10, no labels, 0.02 mm white noise."""
    case.size[:2] = np.maximum(case.size[:2], 38)
    parts = apart(case, [case.draw(5, 6.5) for _ in range(3)])
    base = case.draw(15, 28)
    young = {1: base, 2: 0.5 * base, 3: 3 * base, 4: 10 * base}
    press(case, Body(case.block(), parts, 3.2, ball_sizes(parts)), young, case.draw(0.04, 0.08) * case.size[2])
    case.named, case.noise = False, (0.02, 0)
    case.note = f"three balls without labels, {case.contact} plates, 0.02 mm white noise"


def layered_nu(case):
    """Layers of Poisson's ratio 0.48, 0.49 and 0.3: a block, or a lying cylinder with flats (core, pulp, skin)."""
    height, half = case.size[2], case.size / 2
    nu = {1: 0.49, 2: 0.48, 3: 0.3}
    young = {1: case.draw(15, 30), 2: case.draw(40, 90), 3: case.draw(60, 200)}
    if case.seed % 2:
        bottom, skin = case.draw(4, 8), case.draw(3, 5)
        parts = [(3, Box([-half[0], -half[1], 0], [half[0], half[1], bottom])),
                 (2, Box([-half[0], -half[1], height - skin], [half[0], half[1], height]))]
        body = Body(case.block(), parts, 3.3, slab_sizes(parts))
        what = "block of layers"
    else:
        flat = case.draw(0.8, 1.5)
        radius, skin, core = height / 2 + flat, case.draw(2.6, 3.6), case.draw(4, 6)
        base = Both(Rod(height / 2, radius, half[0]), Box([-99, -99, 0], [99, 99, height]))
        pulp, bone = Rod(height / 2, radius - skin, half[0]), Rod(height / 2, core, half[0])
        skinned = Body(base, [(2, base), (1, pulp), (3, bone)], 3.6, [(pulp.distance, 2.1), (bone.distance, 2.0)])
        body, what = skinned, "lying cylinder with flats: core, pulp and skin"
    press(case, body, young, case.draw(0.03, 0.07) * height, sticking=True, nu=nu)
    case.extra["poisson"] = {str(k): v for k, v in nu.items()}
    case.note = f"{what}; Poisson's ratios 0.49, 0.48, 0.3 for the labels 1, 2, 3"


def small_strain(case):
    """Linear law, strains to 5 %."""
    parts = [case.ball()]
    young = {1: case.draw(15, 30), 2: young_contrast(case)}
    press(case, Body(case.block(), parts, 3.2, ball_sizes(parts)), young, case.draw(0.012, 0.03) * case.size[2], large=False)
    case.args = ["--model", "linear"] if case.rng.random() < 0.3 else []
    case.note = f"linear law, ball between {case.contact} plates"


def young_contrast(case):
    """A modulus much softer or stiffer than 20 kPa."""
    return case.draw(5, 11) if case.rng.random() < 0.3 else case.draw(40, 200, True)


def large_strain(case):
    """Neo-Hookean, 20 % compression."""
    parts = [case.ball()]
    young = {1: case.draw(15, 28), 2: case.draw(40, 120)}
    press(case, Body(case.block(), parts, 3.8, ball_sizes(parts)), young, 0.2 * case.size[2], steps=3)
    case.note = f"20 % compression, ball between {case.contact} plates"


def gradient(case):
    """Modulus of label 1 that varies smoothly by up to 1.25 to 2 times its mean over least; a ball beside it."""
    parts = [case.ball()]
    young = {1: case.draw(15, 28), 2: case.draw(60, 120)}
    direction = case.rng.standard_normal(3)
    direction /= np.linalg.norm(direction)
    share = case.draw(0.2, 0.5)
    reach = np.abs(direction * case.size / 2).sum()
    middle = np.array([0, 0, case.size[2] / 2])

    def modulus(x):
        return young[1] * (1 + share * ((x - middle) @ direction) / reach)

    press(case, Body(case.block(), parts, 3.2, ball_sizes(parts)), young, case.draw(0.03, 0.08) * case.size[2], modulus=modulus)
    places = np.einsum("qa,eai->eqi", shape_values(quadrature()[0]), case.mesh.x[case.mesh.tets])
    weight = (case.mesh.geometry(quadrature()[0])[1] * quadrature()[1])[case.mesh.label == 1]
    case.truth[1] = float((weight * modulus(places[case.mesh.label == 1])).sum() / weight.sum())
    case.extra["smooth"] = True
    case.note = f"label 1 varies by +-{100 * share:.0f} % across the body; truth is its mean over the volume"


def border(case):
    """A stiff ball that reaches a sticking plate."""
    label, ball = case.ball(low=7, high=10)
    up = case.rng.random() < 0.5
    sunk = case.draw(0.1, 0.7) * ball.radius
    ball.centre[2] = case.size[2] - sunk if up else sunk
    parts = [(label, ball)]
    young = {1: case.draw(15, 28), 2: case.draw(50, 200)}
    press(case, Body(case.block(), parts, 3.2, ball_sizes(parts)), young, case.draw(0.03, 0.08) * case.size[2], sticking=True)
    case.note = f"ball cut by the {'loaded' if up else 'held'} plate, its centre {sunk:.1f} mm inside"


def other_nu(case, nu):
    """A ball, or layers, of another Poisson's ratio, which is told."""
    case.nu = nu
    half, height = case.size / 2, case.size[2]
    if case.rng.random() < 0.6:
        parts = [case.ball()]
        sizes = ball_sizes(parts)
    else:
        parts = [(2, Box([-half[0], -half[1], case.draw(6, 12)], [half[0], half[1], case.draw(15, 20)]))]
        sizes = slab_sizes(parts)
    young = {1: case.draw(15, 30), 2: young_contrast(case)}
    press(case, Body(case.block(), parts, 3.2, sizes), young, case.draw(0.03, 0.08) * case.size[2])
    case.note = f"Poisson's ratio {nu:g}, {'ball' if isinstance(parts[0][1], Ball) else 'layer'}, {case.contact} plates"


def friction(case):
    """Partial slip on the loaded plate: nothing in the middle, growing outwards to a part of the motion of free sliding."""
    parts = [case.ball()]
    young = {1: case.draw(15, 28), 2: case.draw(50, 150)}
    depth = case.draw(0.04, 0.08) * case.size[2]
    body = Body(case.block(), parts, 3.2, ball_sizes(parts))
    mesh = make_mesh(body, case.fine)
    nodes = case.top(mesh.x)
    fixed, value = held(mesh)
    mu, lam = lame(by_label(mesh, young), case.nu)
    fixed[nodes, 2], value[nodes, 2] = True, -depth
    free = solve(mesh, mu, lam, fixed, value, steps=1)[0][nodes, :2]
    out = np.linalg.norm(mesh.x[nodes, :2], axis=1)
    stick, most = case.draw(0.0, 0.5), case.draw(0.4, 0.9)
    weight = most * np.clip((out / out.max() - stick) / (1 - stick), 0, 1) ** case.draw(0.7, 1.5)
    fixed[nodes] = True
    value[nodes, :2] = weight[:, None] * free
    u, reaction = solve(mesh, mu, lam, fixed, value, steps=1)
    finish(case, body, mesh, u, reaction, nodes, young)
    case.contact = "partial slip"
    case.note = f"sticks to {100 * stick:.0f} % of the way out, slips up to {100 * most:.0f} % of free sliding at the corners"


def correlated(case):
    """A ball under noise of 0.05 mm that is smooth over 3 voxels (Gaussian of 3 voxels' width at half height)."""
    one_ball(case)
    case.noise = (0.05, 3)
    case.note += ", 0.05 mm noise smooth over 3 voxels"


def swapped(case):
    """Labels under other names: the ball is 1 and the rest 2."""
    one_ball(case)
    case.truth = {1: case.truth[2], 2: case.truth[1]}
    case.voxel_body = lambda labels, centres, grid: np.array([0, 2, 1])[labels]
    case.note += ", the ball is label 1"


def wrong_place(case):
    """The ball's label 3 voxels beside the ball."""
    one_ball(case)
    axis, way = int(case.rng.integers(3)), int(case.rng.choice([-1, 1]))
    ball = case.body.parts[0][1]
    if abs(ball.centre[axis] - [0, 0, case.size[2] / 2][axis]) > 1:
        way = -int(np.sign(ball.centre[axis] - [0, 0, case.size[2] / 2][axis]))

    def moved(labels, centres, grid):
        shift = np.zeros(3)
        shift[axis] = 3 * way * grid.spacing[axis]
        return np.where(labels > 0, np.where(Ball(ball.centre + shift, ball.radius).inside(centres), 2, 1), 0)

    case.voxel_body = moved
    case.extra["wrong_labels"] = True
    case.note += f", its label 3 voxels off along {'xyz'[axis]}"


def no_force(case):
    """No force is told: ratios to the largest region."""
    one_ball(case)
    case.note += ", force not told"


def cut(case):
    """A lying limb that goes on at both ends of the volume, on a bed and under a probe."""
    radius, half = case.draw(15, 19), case.draw(40, 48)
    sunk, shell = case.draw(1.5, 3.0), case.draw(4, 7)
    height = 2 * radius - sunk
    case.size = np.array([2 * half, 2 * radius, height])
    middle = radius - sunk
    base = Both(Rod(middle, radius, half), Box([-99, -99, 0], [99, 99, 99]))
    core = Rod(middle, radius - shell, half)
    long, wide = case.draw(7, 11), case.draw(5, 8)
    probe = Box([-long, -wide, middle + 3], [long, wide, 99])
    near = Box([-20, -99, -99], [20, 99, 99])
    body = Body(base, [(2, base), (1, core), (None, Both(probe, Rod(middle, radius, half)))], 5.0,
                [(near.distance, 3.6), (lambda x: probe_edge(x, long, wide, middle, radius), 1.2)])
    young = {1: case.draw(30, 70), 2: case.draw(12, 28)}
    mesh = make_mesh(body, case.fine)
    fixed, value = held(mesh)
    round_ = np.hypot(mesh.x[:, 1], mesh.x[:, 2] - middle) > radius - 1e-6
    nodes = round_ & (np.abs(mesh.x[:, 0]) <= long + 1e-6) & (np.abs(mesh.x[:, 1]) <= wide + 1e-6) & (mesh.x[:, 2] > middle)
    depth = case.draw(1.2, 2.5)
    plate(mesh, fixed, value, nodes, depth, case.rng.uniform(-0.02, 0.02, 2))
    mu, lam = lame(by_label(mesh, young), case.nu)
    u, reaction = solve(mesh, mu, lam, fixed, value, steps=1)
    finish(case, body, mesh, u, reaction, nodes, young)
    case.extra["crop"] = case.draw(17, 23)
    case.masks = {"load": Box([-long, -wide, -99], [long, wide, 99])}
    case.contact = "sticking"
    case.note = (f"limb of {2 * half:.0f} mm of which the middle {2 * case.extra['crop']:.0f} mm are in the volume; "
                 f"probe {2 * long:.0f} x {2 * wide:.0f} mm")


def probe_edge(x, long, wide, middle, radius):
    """Distance to the edges of a probe on a lying cylinder (mm)."""
    outside = np.hypot(max(abs(x[0]) - long, 0), max(abs(x[1]) - wide, 0))
    inside = min(max(long - abs(x[0]), 0), max(wide - abs(x[1]), 0))
    return float(np.hypot(outside + inside, np.hypot(x[1], x[2] - middle) - radius)) if x[2] > middle else 99.0


def affine(case):
    """A field that is affine, as one that is far too smooth: the affine part of a ball's field. The ball is not to be seen."""
    one_ball(case)
    case.extra.update({"affine": True, "expect": "undetermined"})
    case.note += "; only the affine part of the field is given"


def soft_pad(case):
    """Pressed by a soft round pad: a smooth vertical pressure, so that the patch moves smoothly and not as a rigid body."""
    parts = [case.ball(radius=case.draw(5, 7.5))]
    young = {1: case.draw(15, 28), 2: case.draw(50, 150)}
    height = case.size[2]
    x0, y0 = case.rng.uniform(-3, 3, 2)
    touch = Disc([x0, y0, height], case.draw(9, 13))
    power = case.draw(0.7, 1.5)
    peak = young[1] * case.draw(0.12, 0.25)
    body = Body(case.block(), parts + [(None, touch)], 3.2, ball_sizes(parts) + [(touch.distance, 1.5)])
    mesh = make_mesh(body, case.fine)

    def pressure(x):
        away = ((x[..., 0] - x0) ** 2 + (x[..., 1] - y0) ** 2) / touch.radius**2
        return peak * np.clip(1 - away, 0, 1) ** power

    load = pressed(mesh, height, pressure)
    fixed, value = held(mesh)
    mu, lam = lame(by_label(mesh, young), case.nu)
    u, reaction = solve(mesh, mu, lam, fixed, value, load=load, steps=1)
    finish(case, body, mesh, u, load, case.top(mesh.x), young)
    case.balance = float(np.linalg.norm((reaction + load).sum(axis=0))) / 1000
    case.masks, case.contact = {"load": touch}, "soft pad"
    case.note = f"pressure of a soft pad of {touch.radius:.1f} mm radius, up to {peak:.1f} kPa, goes in {-u[:, 2].min():.2f} mm"


KINDS = {
    "slab_indenter": indent, "slab_indenter_noise": lambda case: indent(case, (0.05, 0)),
    "ball_large": lambda case: one_ball(case, 1.0), "ball_small": lambda case: one_ball(case, -1.0),
    "three_balls": three_balls, "three_balls_unlabelled": three_unlabelled, "layered_nu": layered_nu,
    "small_strain": small_strain, "large_strain": large_strain, "gradient": gradient, "border": border,
    "nu45": lambda case: other_nu(case, 0.45), "nu495": lambda case: other_nu(case, 0.495), "friction": friction,
    "correlated": correlated, "swapped": swapped, "wrong_place": wrong_place, "no_force": no_force, "cut": cut,
    "affine": affine, "soft_pad": soft_pad,
}
CHOOSE = ["slab_indenter", "slab_indenter_noise", "ball_large", "ball_small", "three_balls", "three_balls_unlabelled", "layered_nu",
          "small_strain", "large_strain", "border", "friction", "correlated", "soft_pad", "cut"]


def make_case(kind, seed, fine=1.0):
    """Solves one case."""
    case = Case(kind, seed, fine)
    KINDS[kind](case)
    return case


def make_set(name, out, kinds, seeds, fine):
    """Writes the cases of a set; those whose case.json is there already are left as they are."""
    for kind in kinds:
        for seed in seeds:
            folder = Path(out) / name / f"{kind}_{seed}"
            if (folder / "case.json").exists():
                continue
            began = time.process_time()
            try:
                case = make_case(kind, seed, fine)
                write_case(case, folder)
                spent = time.process_time() - began
                print(f"{kind}_{seed}: {len(case.mesh.tets)} elements, {case.force:.3f} N, {spent:.0f} CPU s; {case.note}", flush=True)
            except Exception as error:  # one case that cannot be made must not end the others
                print(f"{kind}_{seed}: FAILED, {error}", flush=True)


# ---------------------------------------------------------------------------------------------------------- verification


def verify():
    """Patch test, a homogeneous block against the exact large-strain solution, a ball against CalculiX, and finer meshes."""
    points, weights = quadrature()
    exact = [np.dot(weights, (points**[a, b, c]).prod(axis=1)) * 1 for a, b, c in ((0, 0, 0), (1, 0, 0), (1, 1, 1), (3, 0, 0))]
    print("quadrature, error of 1, x, xyz, x^3:", np.abs(np.array(exact) - [1 / 6, 1 / 24, 1 / 720, 1 / 120]).max())
    patch_test()
    uniform_test()
    calculix_test()
    for kind, seed in (("small_strain", 1), ("border", 1), ("slab_indenter", 1)):
        refine_test(kind, seed)


def patch_test():
    """Affine displacement on the whole surface of a body with a curved interface: exact inside, both laws."""
    body = Body(Box([-10, -8, 0], [10, 8, 15]), [(2, Ball([1, 0, 7], 4))], 4)
    mesh = make_mesh(body)
    slope = np.array([[0.02, 0.03, -0.01], [0.01, -0.03, 0.02], [0.0, 0.02, -0.04]])
    surface = np.zeros(len(mesh.x), bool)
    surface[boundary(mesh)] = True
    fixed = np.repeat(surface[:, None], 3, axis=1)
    value = mesh.x @ slope.T
    for large in (False, True):
        u, _ = solve(mesh, *lame(np.full(len(mesh.tets), 20.0), 0.49), fixed, value * fixed, large=large)
        print("patch test", "neo-Hookean" if large else "linear", "largest error (mm):", np.abs(u - value).max())


def uniform_test():
    """A block between sliding plates, 20 % shorter: force against that of uniaxial stress."""
    from scipy.optimize import brentq

    mesh = make_mesh(Body(Box([-10, -8, 0], [10, 8, 15]), [], 5))
    for nu in (0.3, 0.49, 0.495):
        mu, lam = lame(20.0, nu)
        fixed, value = held(mesh, False)
        plate(mesh, fixed, value, np.abs(mesh.x[:, 2] - 15) < 1e-6, 3.0, sticking=False)
        spread = np.ones(len(mesh.tets))
        force = solve(mesh, mu * spread, lam * spread, fixed, value, steps=3)[1][mesh.x[:, 2] > 14.999, 2].sum()
        side = brentq(lambda s: mu * (s - 1 / s) + lam * np.log(s * s * 0.8) / s, 0.9, 1.3)
        exact = 320 * (mu * (0.8 - 1 / 0.8) + lam * np.log(side**2 * 0.8) / 0.8)
        print(f"uniaxial 20 %, nu {nu}: force {force:.6f} mN, exact {exact:.6f}")


def calculix_test(young={1: 20.0, 2: 100.0}, nu=0.3, depth=0.2, fine=1.0):
    """A ball between sticking plates, 1 % shorter, against CalculiX (its own ten-node elements, displacement
    alone, and another compressible neo-Hookean law, which differs at larger strain)."""
    import shutil
    import subprocess
    import tempfile

    if not shutil.which("ccx"):
        return print("CalculiX is not here; not compared")
    body = Body(Box([-13, -13, 0], [13, 13, 20]), [(2, Ball([2, 1, 11], 6))], 2.6, [(Ball([2, 1, 11], 6).distance, 1.8)])
    mesh = make_mesh(body, fine)
    top, base = np.abs(mesh.x[:, 2] - 20) < 1e-6, np.abs(mesh.x[:, 2]) < 1e-6
    fixed = np.repeat((top | base)[:, None], 3, axis=1)
    value = np.zeros_like(mesh.x)
    value[top, 2] = -depth
    mu, lam = lame(by_label(mesh, young), nu)
    for large in (False, True):
        u, reaction = solve(mesh, mu, lam, fixed, value, large=large)
        with tempfile.TemporaryDirectory() as folder:
            job = Path(folder) / "job.inp"
            job.write_text(calculix_input(mesh, young, nu, top, base, depth, large))
            subprocess.run(["ccx", "job"], cwd=folder, capture_output=True, check=True)
            theirs, total = calculix_output((Path(folder) / "job.dat").read_text(), len(mesh.x))
        ours = reaction[top, 2].sum()
        gap = np.linalg.norm(u - theirs, axis=1)
        print(f"CalculiX, {'neo-Hookean' if large else 'linear'}, nu {nu}: force {ours:.3f} mN, theirs {total:.3f} "
              f"({100 * (ours / total - 1):+.3f} %), field differs by {np.sqrt((gap**2).mean()):.5f} mm rms, {gap.max():.4f} most of {depth}")


def calculix_output(text, nodes):
    """Displacement (nodes, 3) in mm and total force along z in mN from CalculiX's table of results, at the last increment."""
    lines = [line for line in text.splitlines() if line.strip()]
    after = [k for k, line in enumerate(lines) if "total force" in line][-1]
    first = [k for k, line in enumerate(lines) if "displacements" in line][-1] + 1
    table = np.array([[float(v) for v in line.split()] for line in lines[first : first + nodes]])
    u = np.zeros((nodes, 3))
    u[table[:, 0].astype(int) - 1] = table[:, 1:]
    return u, float(lines[after + 1].split()[2])


def calculix_input(mesh, young, nu, top, base, depth, large):
    """Input of CalculiX for `calculix_test`."""
    order = [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]
    lines = ["*NODE, NSET=ALL"] + [f"{i + 1}, {a:.9g}, {b:.9g}, {c:.9g}" for i, (a, b, c) in enumerate(mesh.x)]
    for label in young:
        lines.append(f"*ELEMENT, TYPE=C3D10, ELSET=E{label}")
        lines += [", ".join(str(v) for v in [e + 1, *(mesh.tets[e][order] + 1)]) for e in np.flatnonzero(mesh.label == label)]
    for name, nodes in (("TOP", top), ("BASE", base)):
        lines += [f"*NSET, NSET={name}"] + [str(i + 1) for i in np.flatnonzero(nodes)]
    for label, e in young.items():
        mu, lam = lame(e, nu)
        law = ["*HYPERELASTIC, NEO HOOKE", f"{mu / 2:.9g}, {2 / (lam + 2 * mu / 3):.9g}"] if large else ["*ELASTIC", f"{e}, {nu}"]
        lines += [f"*MATERIAL, NAME=M{label}", *law, f"*SOLID SECTION, ELSET=E{label}, MATERIAL=M{label}"]
    lines += ["*STEP, NLGEOM" if large else "*STEP", "*STATIC", "0.25, 1." if large else "1., 1.", "*BOUNDARY", "BASE, 1, 3", "TOP, 1, 2",
              f"TOP, 3, 3, {-depth}", "*NODE PRINT, NSET=TOP, TOTALS=ONLY", "RF", "*NODE PRINT, NSET=ALL", "U", "*END STEP"]
    return "\n".join(lines) + "\n"


def refine_test(kind, seed):
    """Force and field of a case on its mesh and on one with elements 1.5 times smaller."""
    coarse, fine = make_case(kind, seed, 1.0), make_case(kind, seed, 1.5)
    a, b = voxels(coarse), voxels(fine)
    inside = a[2] > 0
    gap = np.linalg.norm(a[3] - b[3], axis=-1)[inside]
    print(f"{kind}_{seed}: {len(coarse.mesh.tets)} -> {len(fine.mesh.tets)} elements, force {coarse.force:.5f} -> {fine.force:.5f} N "
          f"({100 * (coarse.force / fine.force - 1):+.3f} %), field differs by {np.sqrt((gap**2).mean()):.5f} mm rms, {gap.max():.4f} most")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("set", choices=["choose", "report", "verify"])
    parser.add_argument("--out", default="target/bodies", help="folder of sets (default: %(default)s)")
    parser.add_argument("--kinds", help="comma-separated; default: all for report, most for choose")
    parser.add_argument("--seeds", help="comma-separated; default 1,2,3 (choose) and 11,12,13 (report)")
    parser.add_argument("--fine", type=float, default=1.0, help="divides the size of all elements")
    given = parser.parse_args()
    if given.set == "verify":
        return verify()
    kinds = given.kinds.split(",") if given.kinds else CHOOSE if given.set == "choose" else list(KINDS)
    seeds = [int(s) for s in given.seeds.split(",")] if given.seeds else [1, 2, 3] if given.set == "choose" else [11, 12, 13]
    make_set(given.set, given.out, kinds, seeds, given.fine)


if __name__ == "__main__":
    sys.exit(main())
