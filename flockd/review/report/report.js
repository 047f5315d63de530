"use strict";

// The chosen drone's plate at the chosen moment; without this script all plates stand in a row.
for (const viewer of document.querySelectorAll(".plates")) {
  const plates = [...viewer.querySelectorAll("figure")];
  const drones = viewer.querySelector("[name=drone]");
  const moments = viewer.querySelector("[name=moment]");
  const shown = viewer.querySelector("output");
  const ofDrone = () => plates.filter((plate) => plate.dataset.drone === drones.value);
  const show = () => {
    const own = ofDrone();
    moments.max = own.length - 1;
    const chosen = own[Math.min(moments.value, own.length - 1)];
    for (const plate of plates) plate.hidden = plate !== chosen;
    shown.textContent = `${Number(chosen.dataset.time).toFixed(1)} s`;
  };
  viewer.classList.add("one");
  viewer.querySelector(".controls").hidden = false;
  drones.addEventListener("input", show);
  moments.addEventListener("input", show);
  for (const plate of plates) plate.addEventListener("click", () => plate.classList.toggle("large"));
  show();
}

// The flight from above: linear between the steps of its log.
for (const player of document.querySelectorAll(".player")) {
  const flight = JSON.parse(player.querySelector("[type='application/json']").textContent);
  const canvas = player.querySelector("canvas");
  const [play, slider] = [player.querySelector("button"), player.querySelector("[name=time]")];
  const [rate, follow] = [player.querySelector("[name=rate]"), player.querySelector("[name=follow]")];
  const shown = player.querySelector("output");
  const last = flight.time.length - 1;
  const all = flight.position.flat();
  const reach = (axis) => [Math.min(...all.map((p) => p[axis])), Math.max(...all.map((p) => p[axis]))];
  const [norths, easts] = [reach(0), reach(1)];
  let [time, ticked, playing] = [flight.time[0], 0, false];

  const stepAt = (t) => {
    let step = 0;
    while (step < last && flight.time[step + 1] <= t) step += 1;
    return step;
  };
  const at = (t) => {
    const step = stepAt(t);
    if (step === last) return flight.position[last];
    const share = (t - flight.time[step]) / (flight.time[step + 1] - flight.time[step]);
    return flight.position[step].map((p, i) => p.map((v, axis) => v + share * (flight.position[step + 1][i][axis] - v)));
  };
  const closest = (places) => {
    let least = Infinity;
    for (let i = 0; i < places.length; i += 1) {
      for (let j = i + 1; j < places.length; j += 1) {
        least = Math.min(least, Math.hypot(...places[i].map((v, axis) => v - places[j][axis])));
      }
    }
    return least;
  };

  // Beside each drone, or a line higher or lower where another's label or the drone itself would be under it.
  const label = (pen, pixels, places, ink, width) => {
    const [wide, line, radius] = [92, 14, 7];
    const taken = [];
    const isFree = (i, left, middle) =>
      taken.every(([l, m]) => Math.abs(m - middle) >= line || Math.abs(l - left) >= wide) &&
      pixels.every(([u, v], j) => j === i || Math.abs(v - middle) >= radius + line / 2 || u < left - radius || u > left + wide + radius);
    pen.fillStyle = ink;
    for (const i of pixels.map((_, i) => i).sort((a, b) => pixels[a][1] - pixels[b][1])) {
      const [u, v] = pixels[i];
      const isLeft = u > width - 90;
      const left = isLeft ? u - 11 - wide : u + 11;
      const aside = [0, -1, 1, -2, 2, -3, 3].map((n) => n * line).find((shift) => isFree(i, left, v + shift)) ?? 0;
      taken.push([left, v + aside]);
      pen.textAlign = isLeft ? "right" : "left";
      pen.fillText(`${i + 1}, ${places[i][2].toFixed(1)} m`, u + (isLeft ? -11 : 11), v + aside);
    }
  };

  const draw = () => {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const dense = window.devicePixelRatio || 1;
    [canvas.width, canvas.height] = [width * dense, height * dense];
    const pen = canvas.getContext("2d");
    pen.scale(dense, dense);
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name).trim();
    const places = at(time);
    let [north, east] = [(norths[0] + norths[1]) / 2, (easts[0] + easts[1]) / 2];
    let metres = Math.max((norths[1] - norths[0]) / (height - 60), (easts[1] - easts[0]) / (width - 60));
    if (follow.checked) {
      [north, east] = [0, 1].map((axis) => places.reduce((sum, p) => sum + p[axis], 0) / places.length);
      const far = Math.max(3, ...places.flatMap((p) => [Math.abs(p[0] - north), Math.abs(p[1] - east)]));
      metres = (2 * far) / (Math.min(width, height) - 90);
    }
    metres = Math.max(metres, 0.004);
    const x = (p) => width / 2 + (p[1] - east) / metres;
    const y = (p) => height / 2 - (p[0] - north) / metres;

    const spacing = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((m) => m / metres >= 60) || 1000;
    pen.strokeStyle = colour("--grid");
    pen.lineWidth = 1;
    pen.beginPath();
    for (let e = Math.ceil((east - (width / 2) * metres) / spacing) * spacing; x([0, e]) < width; e += spacing) {
      pen.moveTo(x([0, e]), 0);
      pen.lineTo(x([0, e]), height);
    }
    for (let n = Math.ceil((north - (height / 2) * metres) / spacing) * spacing; y([n, 0]) > 0; n += spacing) {
      pen.moveTo(0, y([n, 0]));
      pen.lineTo(width, y([n, 0]));
    }
    pen.stroke();

    for (const [n, e, length, width, heading, inTheWay] of flight.obstacles) {
      pen.fillStyle = inTheWay ? "#8a7355" : colour("--grid");
      pen.beginPath();
      if (width === 0) {
        pen.arc(x([n, e]), y([n, e]), Math.max(length / metres, 1), 0, 2 * Math.PI);
      } else {
        const [along, across] = [[Math.cos(heading), Math.sin(heading)], [-Math.sin(heading), Math.cos(heading)]];
        for (const [a, b] of [[1, 1], [1, -1], [-1, -1], [-1, 1]]) {
          const corner = [n, e].map((v, axis) => v + a * length * along[axis] + b * width * across[axis]);
          pen.lineTo(x(corner), y(corner));
        }
      }
      pen.fill();
    }

    const step = stepAt(time);
    places.forEach((place, i) => {
      pen.strokeStyle = flight.colours[i];
      for (const [from, alpha] of [[0, 0.3], [Math.max(0, stepAt(time - 5)), 1]]) {
        pen.globalAlpha = alpha;
        pen.lineWidth = 1.5;
        pen.beginPath();
        for (let s = from; s <= step; s += 1) pen.lineTo(x(flight.position[s][i]), y(flight.position[s][i]));
        pen.lineTo(x(place), y(place));
        pen.stroke();
      }
    });
    pen.globalAlpha = 1;
    pen.textBaseline = "middle";
    pen.font = `12px ${colour("--sans")}`;
    places.forEach((place, i) => {
      pen.fillStyle = flight.colours[i];
      pen.beginPath();
      pen.arc(x(place), y(place), 7, 0, 2 * Math.PI);
      pen.fill();
    });
    if (places.length <= 12) label(pen, places.map((place) => [x(place), y(place)]), places, colour("--ink"), width);
    pen.textAlign = "left";
    pen.fillStyle = colour("--muted");
    pen.fillText(`north up, lines every ${spacing} m`, 8, height - 12);
    const gap = places.length > 1 ? `, closest ${closest(places).toFixed(2)} m in 3D` : "";
    shown.textContent = `${time.toFixed(1)} s${gap}`;
    slider.value = time;
  };
  const tick = (now) => {
    if (!playing) return;
    const passed = Math.max(0, now - ticked); // a frame's time stamp may lie before the click that asked for it
    time = Math.min(time + (passed / 1000) * rate.value, flight.time[last]);
    ticked = now;
    if (time >= flight.time[last]) pause();
    draw();
    requestAnimationFrame(tick);
  };
  const pause = () => {
    playing = false;
    play.textContent = "Play";
  };
  play.addEventListener("click", () => {
    if (playing) return pause();
    if (time >= flight.time[last]) time = flight.time[0];
    [playing, ticked, play.textContent] = [true, performance.now(), "Pause"];
    return requestAnimationFrame(tick);
  });
  slider.addEventListener("input", () => {
    pause();
    time = Number(slider.value);
    draw();
  });
  follow.addEventListener("input", draw);
  window.addEventListener("resize", draw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  slider.min = flight.time[0];
  slider.max = flight.time[last];
  player.hidden = false;
  draw();
}
