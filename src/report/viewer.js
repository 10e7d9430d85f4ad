(() => {
  const root = document.currentScript.previousElementSibling;
  const data = JSON.parse(root.querySelector("script").textContent);
  const $ = (name) => root.querySelector(`[name="${name}"]`);
  const on = (name) => $(name) && $(name).checked;
  const canvases = [...root.querySelectorAll("canvas")];
  const readout = root.querySelector("output"), bar = root.querySelector(".bar");
  const note = (text) => { root.querySelector(".state").textContent = text; };
  // Canonical axes: 0 to the right, 1 to the front, 2 up. Across, up and through each plane.
  const AXES = { axial: [0, 1, 2], coronal: [0, 2, 1], sagittal: [1, 2, 0] };
  const planes = data.planes.map((name, n) => ({ name, axes: AXES[name], canvas: canvases[n] }));
  const { extent, colours, moments } = data;
  const cross = data.centre.slice(); // mm from the first corner
  const factors = [1, 1.5, 2, 3, 5, 8, 12, 20, 30, 50];
  let blink = false, timer = null, now = data.first;
  // Of the moment that is shown.
  let images = [], overlays = [], field = null, matches = null, mesh = null;

  const bytesOf = async (text) => {
    const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Response(stream).arrayBuffer();
  };

  // Overlays end at 253; past that is a value beyond the scale, and 255, here no number, one that is not known.
  const END = 253, unknown = 0 / 0, isUnknown = (value) => value !== value;
  // Offsets along one axis of a layer for places in mm: the two voxels around, and the weight of the second.
  const taps = (layer, axis, mm) => {
    const at = Math.min(Math.max((mm - layer.first[axis]) / layer.step[axis], 0), layer.shape[axis] - 1);
    const low = Math.min(Math.floor(at), layer.shape[axis] - 1), high = Math.min(low + 1, layer.shape[axis] - 1);
    return [low, high, at - low];
  };
  const stride = (layer) => [1, layer.shape[0], layer.shape[0] * layer.shape[1]];
  // The value of one component of a layer at a place (mm), linear between voxels; none where most of them are not known.
  const sample = (layer, values, place) => {
    const s = stride(layer), t = [0, 1, 2].map((a) => taps(layer, a, place[a]));
    let sum = 0, sure = 0;
    for (let c = 0; c < 8; c++) {
      let weight = 1, at = 0;
      for (let a = 0; a < 3; a++) {
        const up = (c >> a) & 1;
        weight *= up ? t[a][2] : 1 - t[a][2];
        at += s[a] * t[a][up];
      }
      if (weight && !isUnknown(values[at])) { sum += weight * values[at]; sure += weight; }
    }
    return sure > 0.5 ? sum / sure : unknown;
  };
  const motion = (place) => [0, 1, 2].map((c) => sample(field, field.values[c], place) / 100);
  const ofImage = (layer, byte) => layer.low + (byte / 255) * (layer.high - layer.low);
  const real = (layer, byte) => layer.low + (Math.min(byte, END) / END) * (layer.high - layer.low);

  // A section through a layer, pixel by pixel of the image grid; smooth layers are interpolated, images are not.
  const cut = (plane, layer, values, grid, smooth) => {
    const [h, v, n] = plane.axes, s = stride(layer), width = grid.shape[h], height = grid.shape[v];
    const out = new Float32Array(width * height);
    const across = (axis, count) => Array.from({ length: count }, (_, i) => taps(layer, axis, grid.first[axis] + i * grid.step[axis]));
    const xs = across(h, width), ys = across(v, height), through = taps(layer, n, cross[n]);
    const near = (t) => t[t[2] > 0.5 ? 1 : 0];
    for (let y = 0; y < height; y++) {
      const ty = ys[height - 1 - y];
      for (let x = 0; x < width; x++) {
        const tx = xs[x];
        if (!smooth) {
          out[y * width + x] = values[s[h] * near(tx) + s[v] * near(ty) + s[n] * near(through)];
          continue;
        }
        let sum = 0, sure = 0;
        for (let c = 0; c < 8; c++) {
          const a = c & 1, b = (c >> 1) & 1, d = c >> 2;
          const weight = (a ? tx[2] : 1 - tx[2]) * (b ? ty[2] : 1 - ty[2]) * (d ? through[2] : 1 - through[2]);
          const value = values[s[h] * tx[a] + s[v] * ty[b] + s[n] * through[d]];
          if (weight && !isUnknown(value)) { sum += weight * value; sure += weight; }
        }
        out[y * width + x] = sure > 0.5 ? sum / sure : unknown;
      }
    }
    return out;
  };

  const length = (plane, grid) => {
    const parts = field.values.map((c) => cut(plane, field, c, grid, true));
    return parts[0].map((x, i) => Math.hypot(x, parts[1][i], parts[2][i]) / 100);
  };

  const chosen = (name, list) => list[+$(name).value];

  // Where the colour of a value begins in its table.
  const entry = ({ bottom, top }, value) => 3 * Math.round(255 * Math.min(1, Math.max(0, (value - bottom) / (top - bottom))));
  const paint = (plane) => {
    const first = chosen("image", images), second = chosen("other", images), compare = $("compare").value;
    const grid = first, [h, v] = plane.axes, width = grid.shape[h], height = grid.shape[v];
    const one = cut(plane, first, first.values, grid, false);
    const two = compare === "alone" ? one : cut(plane, second, second.values, grid, false);
    const overlay = chosen("colour", overlays), opacity = $("opacity").value / 100;
    let coloured = null, inside = null, bounded = null;
    if (overlay) {
      coloured = overlay.vector ? length(plane, grid) : cut(plane, overlay, overlay.values, grid, true).map((b) => real(overlay, b));
      inside = data.mask.values ? cut(plane, data.mask, data.mask.values, grid, true) : null;
      bounded = overlay.bounds ? cut(plane, overlay, overlay.bounds, grid, true) : null;
    }
    // Stripes of a third of the colour are left out where a value is a bound.
    const stripe = Math.max(1, Math.round(Math.max(width, height) / 60));
    const isGap = (i) => bounded && bounded[i] > 0.5 && ((i % width) + Math.floor(i / width)) % (3 * stripe) < stripe;
    const table = overlay ? colours[overlay.map] : null;
    const square = Math.max(4, Math.round(Math.max(width, height) / 10));
    const picture = new ImageData(width, height), p = picture.data;
    for (let i = 0; i < width * height; i++) {
      const tile = ((i % width) / square ^ Math.floor(i / width) / square) & 1;
      const gray = compare === "flicker" ? (blink ? two[i] : one[i]) : compare === "checkerboard" && tile ? two[i] : one[i];
      let r = gray, g = gray, b = gray;
      if (overlay && !isUnknown(coloured[i]) && (!inside || inside[i] > 0.5) && !isGap(i)) {
        const t = entry(overlay, coloured[i]);
        r += (table[t] - r) * opacity; g += (table[t + 1] - g) * opacity; b += (table[t + 2] - b) * opacity;
      }
      p[4 * i] = r; p[4 * i + 1] = g; p[4 * i + 2] = b; p[4 * i + 3] = 255;
    }
    const sheet = document.createElement("canvas");
    [sheet.width, sheet.height] = [width, height];
    sheet.getContext("2d").putImageData(picture, 0, 0);
    return sheet;
  };

  const css = (rgb) => `rgb(${rgb[0]},${rgb[1]},${rgb[2]})`;
  const colour = (overlay, value) => css(colours[overlay.map].subarray(entry(overlay, value)));

  // Where the plane meets a tetrahedron, or the edges of a triangle in it: segments in mm across and up.
  const drawMesh = (context, plane, point) => {
    const [h, v, n] = plane.axes, { nodes, cells, corners } = mesh, at = cross[n];
    context.beginPath();
    for (let c = 0; c < cells.length; c += corners) {
      let low = Infinity, high = -Infinity;
      for (let k = 0; k < corners; k++) {
        const z = nodes[3 * cells[c + k] + n];
        low = Math.min(low, z); high = Math.max(high, z);
      }
      if (corners === 4 && (low > at || high < at)) continue;
      const hits = [];
      for (let a = 0; a < corners; a++) for (let b = a + 1; b < corners; b++) {
        const i = 3 * cells[c + a], j = 3 * cells[c + b];
        if (corners === 3) {
          context.moveTo(...point(nodes[i + h], nodes[i + v])); context.lineTo(...point(nodes[j + h], nodes[j + v]));
        } else if ((nodes[i + n] < at) !== (nodes[j + n] < at)) {
          const t = (at - nodes[i + n]) / (nodes[j + n] - nodes[i + n]), mix = (x) => nodes[i + x] + t * (nodes[j + x] - nodes[i + x]);
          hits.push([mix(h), mix(v)]);
        }
      }
      if (hits.length > 2) {
        const middle = [0, 1].map((a) => hits.reduce((s, p) => s + p[a], 0) / hits.length);
        hits.sort((p, q) => Math.atan2(p[1] - middle[1], p[0] - middle[0]) - Math.atan2(q[1] - middle[1], q[0] - middle[0]));
        hits.forEach((p, k) => (k ? context.lineTo(...point(...p)) : context.moveTo(...point(...p))));
        context.closePath();
      }
    }
    context.strokeStyle = "rgba(127,212,255,.75)";
    context.stroke();
  };

  const draw = () => {
    planes.forEach((plane) => {
      const { canvas } = plane, [h, v, n] = plane.axes;
      const pixels = Math.max(1, Math.round(canvas.clientWidth * (devicePixelRatio || 1)));
      canvas.width = pixels;
      canvas.height = Math.max(1, Math.round((pixels * extent[v]) / extent[h]));
      const context = canvas.getContext("2d"), scale = pixels / extent[h], fine = Math.max(1, pixels / 420);
      const point = (x, y) => [scale * x, canvas.height - scale * y];
      context.imageSmoothingEnabled = false;
      context.drawImage(paint(plane), 0, 0, canvas.width, canvas.height);
      const factor = factors[+$("factor").value], step = Math.max(extent[h], extent[v]) / 22;
      const node = (x, y) => { const p = cross.slice(); p[h] = x; p[v] = y; return p; };
      const known = (p) => !data.mask.values || sample(data.mask, data.mask.values, p) > 0.5;
      context.lineWidth = fine;
      if (mesh && on("tetrahedra")) drawMesh(context, plane, point);
      if (field && on("grid")) {
        context.strokeStyle = "rgba(255,214,102,.85)";
        const small = step / 4;
        [[h, v], [v, h]].forEach(([along, other]) => {
          for (let o = step / 2; o < extent[other]; o += step) {
            context.beginPath();
            let pen = false;
            for (let a = small / 2; a < extent[along]; a += small) {
              const p = along === h ? node(a, o) : node(o, a);
              if (!known(p)) { pen = false; continue; }
              const u = motion(p), q = point(p[h] + factor * u[h], p[v] + factor * u[v]);
              pen ? context.lineTo(...q) : context.moveTo(...q);
              pen = true;
            }
            context.stroke();
          }
        });
      }
      if (field && on("arrows")) {
        const overlay = overlays.find((o) => o.vector);
        for (let y = step / 2; y < extent[v]; y += step) for (let x = step / 2; x < extent[h]; x += step) {
          const p = node(x, y);
          if (!known(p)) continue;
          const u = motion(p), [ax, ay] = point(x, y), [bx, by] = point(x + factor * u[h], y + factor * u[v]);
          const d = Math.hypot(bx - ax, by - ay);
          if (d < 1.5 * fine) continue;
          const head = Math.min(d * 0.4, 6 * fine), angle = Math.atan2(by - ay, bx - ax);
          context.beginPath();
          context.moveTo(ax, ay); context.lineTo(bx, by);
          [2.6, -2.6].forEach((turn) => { context.moveTo(bx, by); context.lineTo(bx + head * Math.cos(angle + turn), by + head * Math.sin(angle + turn)); });
          // A dark edge shows them on any colour; over a coloured map they are white.
          const own = overlay && !chosen("colour", overlays) ? colour(overlay, Math.hypot(...u)) : "#fff";
          [["rgba(0,0,0,.75)", 3.6], [own, 1.7]].forEach(([stroke, width]) => {
            context.strokeStyle = stroke;
            context.lineWidth = width * fine;
            context.stroke();
          });
        }
      }
      if (matches && on("matches")) {
        const slab = Math.max(images[0].step[n], 1) * 0.75, r = 2.4 * fine, m = matches;
        for (let i = 0; i < m.count; i++) {
          if (Math.abs(m.place[3 * i + n] - cross[n]) > slab) continue;
          const [x, y] = point(m.place[3 * i + h], m.place[3 * i + v]);
          if (m.kept[i]) {
            context.fillStyle = colour(m, real(m, m.sigma[i]));
            context.beginPath(); context.arc(x, y, r, 0, 7); context.fill();
          } else {
            context.strokeStyle = "rgba(255,90,95,.8)";
            context.lineWidth = fine;
            context.beginPath();
            context.moveTo(x - r, y - r); context.lineTo(x + r, y + r); context.moveTo(x - r, y + r); context.lineTo(x + r, y - r);
            context.stroke();
          }
        }
      }
      if (on("cross")) {
        const [x, y] = point(cross[h], cross[v]), gap = 7 * fine;
        context.strokeStyle = "rgba(80,220,120,.8)";
        context.lineWidth = fine;
        context.beginPath();
        [[0, y, x - gap, y], [x + gap, y, canvas.width, y], [x, 0, x, y - gap], [x, y + gap, x, canvas.height]].forEach(([a, b, c, d]) => { context.moveTo(a, b); context.lineTo(c, d); });
        context.stroke();
      }
      plane.slider.value = cross[n];
    });
    say();
  };

  const reading = (layer, byte) => {
    if (isUnknown(byte)) return "unknown";
    const bound = layer.bounds ? Math.round(sample(layer, layer.bounds, cross)) : 0;
    return `${bound === 2 ? "at most " : bound || byte > END + 0.5 ? "at least " : ""}${short(real(layer, byte))} ${layer.unit}`.trim();
  };
  const short = (v) => (Math.abs(v) >= 100 ? v.toFixed(0) : v.toFixed(2));
  const say = () => {
    const world = data.affine.map((row) => row[0] * cross[0] + row[1] * cross[1] + row[2] * cross[2] + row[3]);
    const parts = [`x ${world[0].toFixed(1)}, y ${world[1].toFixed(1)}, z ${world[2].toFixed(1)} mm`];
    images.forEach((i) => parts.push(`${i.name} ${short(ofImage(i, sample(i, i.values, cross)))}`));
    if (field) parts.push(`motion ${short(Math.hypot(...motion(cross)))} mm`);
    overlays.filter((o) => !o.vector).forEach((o) => parts.push(`${o.name.toLowerCase()} ${reading(o, sample(o, o.values, cross))}`));
    readout.textContent = parts.join(" · ");
    const overlay = chosen("colour", overlays);
    $("factor").nextElementSibling.textContent = `${factors[+$("factor").value]}×`;
    bar.hidden = !overlay;
    if (overlay) {
      const stops = Array.from({ length: 9 }, (_, i) => css(colours[overlay.map].subarray(3 * Math.round(i * 31.875), 3 * Math.round(i * 31.875) + 3)));
      bar.querySelector("i").style.background = `linear-gradient(90deg,${stops.join(",")})`;
      const trim = (v) => String(+v.toFixed(3)), marks = bar.querySelectorAll("span");
      marks[0].textContent = trim(overlay.bottom);
      marks[1].textContent = trim((overlay.bottom + overlay.top) / 2);
      marks[2].textContent = `${trim(overlay.top)} ${overlay.unit}`;
    }
  };

  const move = (plane, event) => {
    const box = plane.canvas.getBoundingClientRect(), [h, v] = plane.axes;
    const inside = (t, axis) => Math.min(Math.max(t, 0), 1) * extent[axis];
    const mirror = document.getElementById("radiological"), across = (event.clientX - box.left) / box.width;
    cross[h] = inside(h === 0 && mirror && mirror.checked ? 1 - across : across, h);
    cross[v] = inside(1 - (event.clientY - box.top) / box.height, v);
    draw();
  };
  const flicker = () => {
    clearInterval(timer);
    timer = null;
    blink = false;
    if ($("compare").value === "flicker") timer = setInterval(() => { blink = !blink; draw(); }, 700);
  };
  // The largest factor at which the longest arrow of the scale still fits between two of them.
  const fitted = () => {
    const overlay = overlays.find((o) => o.vector), room = Math.max(...extent) / 22;
    const fits = factors.filter((f) => overlay && f * overlay.high <= room);
    $("factor").value = Math.max(0, fits.length - 1);
  };
  const start = () => {
    fitted();
    planes.forEach((plane, k) => {
      const n = plane.axes[2];
      plane.slider = root.querySelectorAll("figure + input")[k];
      Object.assign(plane.slider, { min: 0, max: extent[n], step: images[0].step[n] });
      plane.slider.addEventListener("input", () => { cross[n] = +plane.slider.value; draw(); });
      plane.canvas.addEventListener("pointerdown", (e) => { plane.canvas.setPointerCapture(e.pointerId); move(plane, e); });
      plane.canvas.addEventListener("pointermove", (e) => { if (e.buttons) move(plane, e); });
      plane.canvas.addEventListener("wheel", (e) => {
        e.preventDefault();
        cross[n] = Math.min(Math.max(cross[n] - Math.sign(e.deltaY) * images[0].step[n], 0), extent[n]);
        draw();
      }, { passive: false });
    });
    root.querySelectorAll(".choices select, .choices input").forEach((e) => e.addEventListener("input", async () => {
      if (e.name === "moment") {
        await show(+e.value);
        if (now !== +e.value) return;
      }
      $("other").hidden = $("compare").value === "alone";
      flicker();
      draw();
    }));
    addEventListener("resize", draw);
    flicker();
    draw();
    root.dataset.ready = "yes";
    note("");
  };

  const bytes = async (layer) => {
    if (layer.data) layer.values = new Uint8Array(await bytesOf(layer.data));
    if (layer.bounds) layer.bounds = new Uint8Array(await bytesOf(layer.bounds));
  };
  const unpack = async (moment) => {
    await Promise.all(moment.images.map(bytes));
    await Promise.all(moment.overlays.map(bytes));
    moment.overlays.filter((o) => o.values).forEach((o) => { o.values = Float32Array.from(o.values, (b) => (b > END + 1 ? unknown : b)); });
    if (moment.field) {
      const all = new Int16Array(await bytesOf(moment.field.data)), n = all.length / 3;
      moment.field.values = [0, 1, 2].map((c) => all.subarray(c * n, (c + 1) * n));
    }
    const places = (buffer) => Float32Array.from(new Uint16Array(buffer), (v, i) => (v / 65535) * extent[i % 3]);
    if (moment.matches) {
      const m = moment.matches, [place, sigma, kept] = await Promise.all([m.place, m.sigma, m.kept].map(bytesOf));
      Object.assign(m, { place: places(place), sigma: new Uint8Array(sigma), kept: new Uint8Array(kept), count: sigma.byteLength });
    }
    if (moment.mesh) {
      const m = moment.mesh, [nodes, cells] = await Promise.all([m.nodes, m.cells].map(bytesOf));
      Object.assign(m, { nodes: places(nodes), cells: new Uint32Array(cells) });
    }
  };
  // Makes a moment the one that is shown, unless another was asked for meanwhile.
  const show = async (number) => {
    const moment = moments[number];
    now = number;
    moment.ready = moment.ready || unpack(moment);
    await moment.ready;
    if (now !== number) return;
    images = [...data.images, ...moment.images];
    ({ overlays, field, matches, mesh } = moment);
    if ($("moment")) $("moment").nextElementSibling.textContent = moment.name;
  };

  const load = async () => {
    if (typeof DecompressionStream === "undefined") throw new Error("it needs a newer browser; the pictures below show the same");
    await Promise.all([...data.images, data.mask].map(bytes));
    Object.keys(colours).forEach((k) => { colours[k] = Uint8Array.from(atob(colours[k]), (c) => c.charCodeAt(0)); });
    // Colours mean the same at all moments.
    const range = (layers) => layers.forEach((l) => {
      l.bottom = Math.min(...layers.map((o) => o.low));
      l.top = Math.max(...layers.map((o) => o.high));
    });
    moments[0].overlays.forEach((_, k) => range(moments.map((m) => m.overlays[k])));
    range(moments.map((m) => m.matches).filter((m) => m));
    await show(now);
  };
  load().then(start, (error) => note(`The viewer cannot start: ${error.message}.`));
})();
