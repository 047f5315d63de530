// The fleet from above: north is up. Drawn when something has changed.
import { colourOf, lastPlaceOf, nameOf, placeOf, recent, state } from "./fleet_state.js";

const [TRAIL_S, SHORT_TRAIL_S] = [60, 20];
const FAR_M = 20000; // from the middle of the flock
const FEW = 10; // up to so many drones show their neighbours all at once

function median(values) {
  return [...values].sort((a, b) => a - b)[values.length >> 1] ?? 0;
}

export class FleetMap {
  constructor(section, choose, send) {
    this.canvas = section.querySelector("canvas");
    this.note = section.querySelector(".note");
    this.legend = section.querySelector(".obstacles");
    this.neighbours = section.querySelector("[name=neighbours]");
    this.follow = section.querySelector("[name=follow]");
    [this.choose, this.send] = [choose, send];
    this.sends = section.querySelector("[name=goal]");
    this.view = { north: 0, east: 0, metres: 0.05 };
    this.waiting = false;
    this.neighbours.addEventListener("input", () => this.changed());
    this.follow.addEventListener("input", () => this.changed());
    section.querySelector("[name=in]").addEventListener("click", () => this.zoom(0.7));
    section.querySelector("[name=out]").addEventListener("click", () => this.zoom(1 / 0.7));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.changed());
    new ResizeObserver(() => this.changed()).observe(this.canvas);
    this.listen();
  }

  changed() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.draw();
    });
  }

  zoom(factor, at = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2]) {
    const before = this.ground(at);
    this.view.metres = Math.min(Math.max(this.view.metres * factor, 0.002), 50);
    const after = this.ground(at);
    this.view.north += before[0] - after[0];
    this.view.east += before[1] - after[1];
    this.follow.checked = false;
    this.changed();
  }

  ground([x, y]) {
    const { north, east, metres } = this.view;
    return [north - (y - this.canvas.clientHeight / 2) * metres, east + (x - this.canvas.clientWidth / 2) * metres];
  }

  pixel([north, east]) {
    const { view, canvas } = this;
    return [
      canvas.clientWidth / 2 + (east - view.east) / view.metres,
      canvas.clientHeight / 2 - (north - view.north) / view.metres,
    ];
  }

  listen() {
    const fingers = new Map();
    let [moved, spread] = [0, 0];
    const apart = () => {
      const [a, b] = [...fingers.values()];
      return Math.hypot(a[0] - b[0], a[1] - b[1]);
    };
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(event.deltaY > 0 ? 1.15 : 1 / 1.15, [event.offsetX, event.offsetY]);
    }, { passive: false });
    this.canvas.addEventListener("pointerdown", (event) => {
      this.canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
      moved = 0;
      if (fingers.size === 2) spread = apart();
    });
    this.canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const here = [event.offsetX, event.offsetY];
      fingers.set(event.pointerId, here);
      moved += Math.hypot(here[0] - before[0], here[1] - before[1]);
      if (fingers.size === 2) {
        const now = apart();
        this.zoom(spread / Math.max(now, 1), here);
        spread = now;
      } else if (moved > 4) {
        this.view.north += (here[1] - before[1]) * this.view.metres;
        this.view.east -= (here[0] - before[0]) * this.view.metres;
        this.follow.checked = false;
        this.changed();
      }
    });
    const end = (event) => {
      if (fingers.size === 1 && moved <= 4 && event.type === "pointerup") this.clicked([event.offsetX, event.offsetY]);
      fingers.delete(event.pointerId);
    };
    this.canvas.addEventListener("pointerup", end);
    this.canvas.addEventListener("pointercancel", end);
  }

  clicked(at) {
    let [nearest, least] = [null, 20];
    for (const [key, place] of this.places || []) {
      const [x, y] = this.pixel(place);
      const far = Math.hypot(x - at[0], y - at[1]);
      if (far < least) [nearest, least] = [key, far];
    }
    if (nearest || !this.sends.checked || this.alone) this.choose(nearest);
    else this.send(this.ground(at));
  }

  // Where each drone is, or was last; without any position one drone's own view, with it in the middle.
  located() {
    const places = new Map();
    for (const key of state.order) {
      const place = placeOf(state.rows.get(key)) || lastPlaceOf(key);
      if (place) places.set(key, place);
    }
    this.alone = null;
    if (places.size === 0 && state.order.length) {
      this.alone = state.rows.has(state.chosen) ? state.chosen : [...state.order].sort()[0];
      places.set(this.alone, [0, 0]);
    }
    this.places = places;
    const unplaced = state.order.length - places.size;
    this.note.textContent = this.alone
      ? `No drone knows its position: ${nameOf(this.alone)} in the middle, the others as it sees them.`
      : unplaced
        ? `${unplaced} without a position ${unplaced === 1 ? "is" : "are"} not on the map.`
        : "";
  }

  // The flock; one that says it is far from the others, which may be nonsense, does not move it out of sight.
  fit() {
    const middle = [0, 1].map((axis) => median([...this.places.values()].map((place) => place[axis])));
    const near = (place) => Math.hypot(place[0] - middle[0], place[1] - middle[1]) < FAR_M;
    const keys = [...this.places.keys()].filter((key) => near(this.places.get(key)));
    const points = keys.map((key) => this.places.get(key));
    for (const key of keys) points.push(...this.seenBy(key).map((one) => one.place).filter(near));
    if (!points.length) return;
    const reach = (axis) => [Math.min(...points.map((p) => p[axis])), Math.max(...points.map((p) => p[axis]))];
    const [norths, easts] = [reach(0), reach(1)];
    this.view.north = (norths[0] + norths[1]) / 2;
    this.view.east = (easts[0] + easts[1]) / 2;
    const wanted = Math.max(
      (norths[1] - norths[0] + 4) / Math.max(this.canvas.clientHeight - 110, 60),
      (easts[1] - easts[0] + 4) / Math.max(this.canvas.clientWidth - 90, 60),
    );
    // Steps of a quarter, so that the scale does not tremble with the drones.
    this.view.metres = 1.25 ** Math.ceil(Math.log(wanted) / Math.log(1.25));
  }

  seenBy(key) {
    const [place, row] = [this.places.get(key), state.rows.get(key)];
    return row.sees.filter((one) => one.ned).map((one) => ({
      ...one, place: [place[0] + one.ned[0], place[1] + one.ned[1]],
    }));
  }

  draw() {
    const { canvas } = this;
    const [width, height, dense] = [canvas.clientWidth, canvas.clientHeight, window.devicePixelRatio || 1];
    if (canvas.width !== Math.round(width * dense) || canvas.height !== Math.round(height * dense)) {
      [canvas.width, canvas.height] = [Math.round(width * dense), Math.round(height * dense)];
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(dense, 0, 0, dense, 0, 0);
    pen.clearRect(0, 0, width, height);
    const style = getComputedStyle(document.documentElement);
    this.ink = (name) => style.getPropertyValue(`--${name}`).trim();
    this.located();
    if (this.follow.checked) this.fit();
    this.grid(pen, width, height);
    const keys = [...this.places.keys()];
    const all = this.neighbours.checked && keys.length <= FEW;
    this.fences(pen);
    for (const key of keys) this.trail(pen, key, keys.length <= FEW || key === state.chosen ? TRAIL_S : SHORT_TRAIL_S);
    let obstacles = false;
    for (const key of keys) {
      if (all || key === state.chosen || key === this.alone) this.sight(pen, key);
      if (keys.length <= FEW || key === state.chosen) obstacles = this.obstacles(pen, key) || obstacles;
      this.goal(pen, key);
    }
    for (const key of [...keys].reverse()) this.drone(pen, key); // the first one, which gets the label, on top
    this.labels(pen, keys);
    this.legend.hidden = !obstacles;
    this.sends.parentElement.hidden = !state.mayCommand;
  }

  grid(pen, width, height) {
    const { metres } = this.view;
    const spacing = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 5000].find((m) => m / metres >= 60) || 20000;
    const [top, left] = this.ground([0, 0]);
    const [bottom, right] = this.ground([width, height]);
    pen.strokeStyle = this.ink("grid");
    pen.lineWidth = 1;
    pen.beginPath();
    for (let east = Math.ceil(left / spacing) * spacing; east < right; east += spacing) {
      const [x] = this.pixel([0, east]);
      pen.moveTo(x, 0);
      pen.lineTo(x, height);
    }
    for (let north = Math.ceil(bottom / spacing) * spacing; north < top; north += spacing) {
      const [, y] = this.pixel([north, 0]);
      pen.moveTo(0, y);
      pen.lineTo(width, y);
    }
    pen.stroke();
    pen.fillStyle = this.ink("muted");
    pen.strokeStyle = this.ink("muted");
    pen.font = "12px system-ui, sans-serif";
    pen.textAlign = "right";
    pen.beginPath();
    pen.moveTo(width - 12 - spacing / metres, height - 14);
    pen.lineTo(width - 12, height - 14);
    pen.stroke();
    pen.fillText(`${spacing} m`, width - 12, height - 19);
    pen.textAlign = "center";
    pen.fillText("N", width - 20, height - 56);
    pen.beginPath();
    pen.moveTo(width - 20, height - 52);
    pen.lineTo(width - 15, height - 38);
    pen.lineTo(width - 20, height - 41);
    pen.lineTo(width - 25, height - 38);
    pen.fill();
  }

  line(pen, points, closed = false) {
    pen.beginPath();
    for (const point of points) pen.lineTo(...this.pixel(point));
    if (closed) pen.closePath();
    pen.stroke();
  }

  // Fences that several drones share are drawn once.
  fences(pen) {
    const drawn = new Set();
    pen.strokeStyle = this.ink("bad");
    pen.lineWidth = 1.5;
    pen.setLineDash([7, 5]);
    for (const key of this.places.keys()) {
      const { fence, home_ne: home } = state.rows.get(key);
      const name = JSON.stringify([fence, home]);
      if (!fence || drawn.has(name) || key === this.alone) continue;
      drawn.add(name);
      const [north, east] = home || [0, 0];
      if (fence.radius_m) {
        pen.beginPath();
        pen.arc(...this.pixel([north, east]), fence.radius_m / this.view.metres, 0, 2 * Math.PI);
        pen.stroke();
      }
      this.line(pen, fence.corners_m.map((corner) => [north + corner[0], east + corner[1]]), true);
    }
    pen.setLineDash([]);
  }

  trail(pen, key, seconds) {
    pen.strokeStyle = colourOf(key);
    pen.lineWidth = 1.5;
    pen.globalAlpha = 0.45;
    const path = recent(key, seconds).filter((point) => point[1] !== null).map((point) => [point[1], point[2]]);
    this.line(pen, [...path, this.places.get(key)]);
    pen.globalAlpha = 1;
  }

  sight(pen, key) {
    const place = this.places.get(key);
    pen.strokeStyle = colourOf(key);
    for (const one of this.seenBy(key)) {
      pen.globalAlpha = one.confirmed ? 0.75 : 0.3;
      pen.lineWidth = key === state.chosen ? 1.6 : 0.8;
      this.line(pen, [place, one.place]);
      pen.beginPath();
      pen.arc(...this.pixel(one.place), Math.max(4, (one.sigma_m || 0) / this.view.metres), 0, 2 * Math.PI);
      pen.stroke();
      if (key !== state.chosen) continue;
      const [x, y] = this.pixel(one.place);
      pen.fillStyle = this.ink("ink");
      pen.fillText(`#${one.track}`, x - 8, y + 18);
    }
    pen.globalAlpha = 1;
  }

  obstacles(pen, key) {
    const ranges = state.rows.get(key).obstacles_m;
    if (!ranges) return false;
    const [north, east] = this.places.get(key);
    pen.fillStyle = this.ink("muted");
    ranges.forEach((range, sector) => {
      if (range === null) return;
      const azimuth = (2 * Math.PI * sector) / ranges.length;
      const [x, y] = this.pixel([north + range * Math.cos(azimuth), east + range * Math.sin(azimuth)]);
      pen.fillRect(x - 2, y - 2, 4, 4);
    });
    return true;
  }

  goal(pen, key) {
    const { goal_ne: goal, home_ne: home } = state.rows.get(key);
    if (!goal || key === this.alone) return;
    const [x, y] = this.pixel([goal[0] + (home || [0, 0])[0], goal[1] + (home || [0, 0])[1]]);
    pen.strokeStyle = colourOf(key);
    pen.lineWidth = 2;
    pen.beginPath();
    for (const [a, b] of [[-5, -5], [5, -5]]) {
      pen.moveTo(x + a, y + b);
      pen.lineTo(x - a, y - b);
    }
    pen.stroke();
  }

  drone(pen, key) {
    const row = state.rows.get(key);
    const [x, y] = this.pixel(this.places.get(key));
    const lost = row.state === "gone" || row.state === "quiet";
    const [north, east] = row.velocity_ned || [0, 0];
    pen.strokeStyle = pen.fillStyle = colourOf(key);
    pen.lineWidth = 2;
    pen.globalAlpha = lost ? 0.45 : 1;
    pen.beginPath();
    pen.moveTo(x, y);
    pen.lineTo(x + (2 * east) / this.view.metres, y - (2 * north) / this.view.metres); // where it is in two seconds
    pen.stroke();
    pen.save();
    pen.translate(x, y);
    if (row.yaw_deg === null) {
      pen.beginPath();
      pen.arc(0, 0, 6, 0, 2 * Math.PI);
    } else {
      pen.rotate((row.yaw_deg * Math.PI) / 180);
      pen.beginPath();
      for (const corner of [[0, -10], [6.5, 8], [0, 4.5], [-6.5, 8]]) pen.lineTo(...corner);
      pen.closePath();
    }
    pen.fill();
    pen.restore();
    if (key === state.chosen) {
      pen.strokeStyle = this.ink("accent");
      pen.beginPath();
      pen.arc(x, y, 15, 0, 2 * Math.PI);
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  // The chosen drone's first, then the worst; none over another one.
  labels(pen, keys) {
    const taken = [];
    pen.font = "12px system-ui, sans-serif";
    pen.textAlign = "left";
    const chosen = keys.filter((key) => key === state.chosen);
    for (const key of [...chosen, ...keys.filter((one) => one !== state.chosen)]) {
      const row = state.rows.get(key);
      const lost = row.state === "gone" || row.state === "quiet";
      const height = row.height_m === null || keys.length > FEW ? "" : `  ${row.height_m.toFixed(1)} m`;
      const label = `${nameOf(key)}${height}${lost ? `  ${row.state}` : ""}`;
      const [x, y] = this.pixel(this.places.get(key));
      const box = [x + 10, y - 20, x + 14 + pen.measureText(label).width, y - 4];
      if (taken.some((other) => box[0] < other[2] && other[0] < box[2] && box[1] < other[3] && other[1] < box[3])) continue;
      taken.push(box);
      pen.fillStyle = lost ? this.ink("bad") : this.ink("ink");
      pen.fillText(label, x + 12, y - 7);
    }
  }
}
