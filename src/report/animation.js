(() => {
  const root = document.currentScript.previousElementSibling;
  const { planes, colours, clock } = JSON.parse(root.querySelector("script").textContent);
  const [button, slider, output] = ["button", "input[type=range]", "output"].map((s) => root.querySelector(s));
  const [mesh, strain] = ["mesh", "strain"].map((n) => root.querySelector(`input[name=${n}]`));
  const canvases = [...root.querySelectorAll("canvas")];
  const images = planes.map((p) => p.pictures.map((uri) => Object.assign(new Image(), { src: uri })));
  let frame = 0, timer = null;
  const draw = () => {
    planes.forEach((plane, n) => {
      const canvas = canvases[n], [width, height] = plane.size;
      const pixels = Math.max(1, Math.round(canvas.clientWidth * (window.devicePixelRatio || 1)));
      canvas.width = pixels;
      canvas.height = Math.max(1, Math.round((pixels * height) / width));
      const context = canvas.getContext("2d"), scale = pixels / width;
      context.imageSmoothingEnabled = false;
      const image = images[n][frame];
      if (image.complete && image.naturalWidth) context.drawImage(image, 0, 0, canvas.width, canvas.height);
      const places = plane.places[frame];
      plane.cells.forEach((cell, c) => {
        context.beginPath();
        cell.forEach((node, k) => {
          const [x, y] = places[node];
          if (k === 0) context.moveTo(scale * x, scale * y);
          else context.lineTo(scale * x, scale * y);
        });
        context.closePath();
        if (strain.checked) {
          context.globalAlpha = 0.5;
          context.fillStyle = colours[plane.strain[frame][c]];
          context.fill();
        }
        if (mesh.checked) {
          context.globalAlpha = 0.55;
          context.strokeStyle = "#7fd4ff";
          context.lineWidth = Math.max(0.5, pixels / 700);
          context.stroke();
        }
        context.globalAlpha = 1;
      });
    });
    output.textContent = clock[frame];
    slider.value = frame;
  };
  const last = clock.length - 1;
  const play = () => {
    button.textContent = "Pause";
    timer = setInterval(() => { frame = frame >= last ? 0 : frame + 1; draw(); }, 180);
  };
  const pause = () => { clearInterval(timer); timer = null; button.textContent = "Play"; };
  button.addEventListener("click", () => (timer === null ? play() : pause()));
  slider.addEventListener("input", () => { pause(); frame = +slider.value; draw(); });
  [mesh, strain].forEach((box) => box.addEventListener("change", draw));
  addEventListener("resize", draw);
  Promise.all(images.flat().map((i) => i.decode().catch(() => null))).then(() => {
    draw();
    if (last > 0 && !matchMedia("(prefers-reduced-motion: reduce)").matches) play();
  });
})();
