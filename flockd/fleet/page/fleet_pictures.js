// Pictures of drones' cameras: on the cards that show theirs, and beside the map, of the drone that is looked through.
import { byName, colourOf, nameOf, put, state } from "./fleet_state.js";

const [EVERY_MS, OF_SIMULATION_MS] = [1000, 400];
const AT_ONCE = 2;
const PICTURE_MS = 3000;

async function failure(reply) {
  return reply.ok ? "" : reply.text();
}

// Why no new picture is there; above it may stand an old one.
function captioned(figure, why) {
  const { camera, came } = figure.dataset;
  return came ? `${camera}, ${Math.round((performance.now() - came) / 1000)} s old: no newer one has come` : `${camera}: ${why}`;
}

export class FleetPictures {
  constructor(simulation) {
    this.simulation = simulation;
    this.places = new Map(); // elements, and the drone whose pictures each has
    this.wanted = new Map();
    this.loading = 0;
    this.again();
  }

  again() {
    this.look();
    setTimeout(() => this.again(), state.simulation ? OF_SIMULATION_MS : EVERY_MS);
  }

  show(place, key) {
    if (this.places.get(place) === key) return;
    place.replaceChildren();
    this.places.set(place, key);
    this.look();
  }

  hide(place) {
    this.places.delete(place);
  }

  changed() {
    for (const [place, key] of this.places) for (const figure of place.children) this.writeSwitch(key, figure);
  }

  // Of a simulated drone's camera.
  writeSwitch(key, figure) {
    const [, button] = figure.children;
    button.hidden = !state.simulation;
    put(button, this.simulation.isOff(key, figure.dataset.camera) ? "Switch on" : "Switch off");
    figure.classList.toggle("off", this.simulation.isOff(key, figure.dataset.camera));
  }

  // New ones, a few at a time: a browser has six connections to a server, and orders need one.
  look() {
    for (const [place, key] of this.places) {
      if (document.hidden || !state.rows.has(key)) continue;
      for (const camera of Object.keys(state.rows.get(key).cameras)) this.wanted.set(this.figure(place, key, camera), key);
    }
    while (this.loading < AT_ONCE && this.wanted.size) this.loadNext();
  }

  async loadNext() {
    const [[figure, key]] = this.wanted;
    this.wanted.delete(figure);
    this.loading += 1;
    await this.fetch(figure, key);
    this.loading -= 1;
    if (this.wanted.size) this.loadNext();
  }

  figure(place, key, camera) {
    const known = [...place.children].find((one) => one.dataset.camera === camera);
    if (known) return known;
    const figure = document.createElement("figure");
    figure.dataset.camera = camera;
    figure.append(new Image(), document.createElement("button"), document.createElement("figcaption"));
    figure.children[1].addEventListener("click", () => this.simulation.switch(key, camera));
    this.writeSwitch(key, figure);
    figure.firstChild.alt = `what the camera ${camera} sees`;
    place.append(figure);
    return figure;
  }

  async fetch(figure, key) {
    const [{ camera }, image] = [figure.dataset, figure.firstChild];
    try {
      const drone = key.split("/").map(encodeURIComponent).join("/");
      const address = `image/${drone}/${encodeURIComponent(camera)}?at=${state.now}`;
      const reply = await fetch(address, { priority: "low", signal: AbortSignal.timeout(PICTURE_MS) });
      const none = reply.status === 204 ? "no picture has come: it has none, or does not answer" : await failure(reply);
      if (none) return put(figure.lastChild, captioned(figure, none));
      const picture = URL.createObjectURL(await reply.blob());
      URL.revokeObjectURL(image.src);
      image.src = picture;
      figure.dataset.came = performance.now();
      put(figure.lastChild, camera);
    } catch {
      put(figure.lastChild, captioned(figure, "the server cannot be reached"));
    }
  }
}

// What one drone sees, large; where a simulation is flown by sight.
export class FleetSight {
  constructor(section, choose, pictures) {
    [this.section, this.choose, this.pictures] = [section, choose, pictures];
    [this.names, this.place] = [section.querySelector(".names"), section.querySelector(".pictures")];
  }

  changed() {
    const keys = state.simulation?.by_sight ? [...state.order].sort(byName) : [];
    this.section.hidden = !keys.length;
    document.body.classList.toggle("by-sight", keys.length > 0);
    if (!keys.length) return this.pictures.hide(this.place);
    if (!this.began) {
      this.began = true;
      return this.choose(keys[0]);
    }
    const key = state.rows.has(state.chosen) ? state.chosen : keys[0];
    const shown = [key, ...keys].join(" ");
    if (shown !== this.shown) {
      this.shown = shown;
      this.names.replaceChildren(...keys.map((one) => this.name(one, one === key)));
    }
    this.pictures.show(this.place, key);
  }

  name(key, pressed) {
    const [button, dot] = [document.createElement("button"), document.createElement("i")];
    button.append(dot, nameOf(key));
    button.style.setProperty("--of-drone", colourOf(key));
    button.setAttribute("aria-pressed", pressed);
    button.addEventListener("click", () => key !== state.chosen && this.choose(key));
    return button;
  }
}
