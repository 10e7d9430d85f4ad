(() => {
  const root = document.currentScript.previousElementSibling;
  const frames = JSON.parse(root.dataset.frames), bases = JSON.parse(root.dataset.bases);
  const find = (name) => root.querySelector(name);
  const [button, slider, clock] = ["button", "input", "output"].map(find);
  const [left, right, object, one, two] = [".f1", ".f2", ".object", ".a1", ".a2"].map(find);
  const arrow = (x, y, dx, dy) => {
    const length = Math.hypot(dx, dy);
    if (length < 0.3) return `M${x} ${y}h0`;
    const head = Math.min(0.35 * length, 4.5) / length;
    const [bx, by, sx, sy] = [-0.87 * head * dx, -0.87 * head * dy, -0.5 * head * dy, 0.5 * head * dx];
    const [tx, ty] = [x + dx, y + dy];
    return `M${x} ${y}L${tx} ${ty}M${tx + bx + sx} ${ty + by + sy}L${tx} ${ty}L${tx + bx - sx} ${ty + by - sy}`;
  };
  const show = (k) => {
    const [t, x, y, turn, a, b, ...f] = frames[k];
    left.setAttribute("transform", `translate(${bases[0]}) rotate(${a})`);
    right.setAttribute("transform", `translate(${bases[1]}) rotate(${b})`);
    object.setAttribute("transform", `translate(${x},${y}) rotate(${turn})`);
    one.setAttribute("d", arrow(...f.slice(0, 4)));
    two.setAttribute("d", arrow(...f.slice(4)));
    clock.textContent = `${t.toFixed(2)} s`;
    slider.value = k;
  };
  const last = frames.length - 1, end = frames[last][0];
  let start = null, frame = 0, at = 0;
  const tick = (now) => {
    at = (now - start) / 1000;
    if (at > end + 0.6) { start = now; at = 0; frame = 0; }
    while (frame < last && frames[frame + 1][0] <= at) frame += 1;
    show(frame);
    if (start !== null) requestAnimationFrame(tick);
  };
  const play = () => {
    button.textContent = "Pause";
    requestAnimationFrame((now) => { start = now - 1000 * frames[frame][0]; tick(now); });
  };
  const pause = () => { start = null; button.textContent = "Play"; };
  button.addEventListener("click", () => (start === null ? play() : pause()));
  slider.addEventListener("input", () => { pause(); frame = +slider.value; show(frame); });
  if (last > 0 && !matchMedia("(prefers-reduced-motion: reduce)").matches) play();
})();
