// One card a drone, made once and then kept up to date where something has changed.
import { STATES, colourOf, nameOf, put, state, written } from "./fleet_state.js";

const PICTURES_EVERY_MS = 1000;
const PICTURES_AT_ONCE = 2;
const PICTURE_MS = 3000;
const VALUES = [
  ["mode", (row) => row.flight_mode || "–"],
  ["motors", (row) => (row.armed === null ? "–" : row.armed ? (row.in_air ? "in the air" : "armed") : "disarmed")],
  ["battery", (row) => written(row.battery_share === null ? null : 100 * row.battery_share, 0, " %"), (row) => row.battery_share !== null && row.battery_share < 0.2],
  ["height", (row) => written(row.height_m, 1, " m")],
  ["speed", (row) => written(row.speed_m_s, 1, " m/s")],
  ["sees", (row) => (row.neighbours === null ? "–" : `${row.neighbours}`)],
  ["steps", (row) => written(row.rate_hz, 1, " /s")],
  ["load", (row) => written(row.load === null ? null : 100 * row.load, 0, " %"), (row) => row.load > 1],
  ["temperature", (row) => written(row.temperature_c, 0, " °C"), (row) => row.temperature_c > 85],
  ["link delay", (row) => written(row.delay_ms, row.delay_ms < 10 ? 1 : 0, " ms")],
  ["clock", (row) => apart(row.clock_s), (row) => Math.abs(row.clock_s) > 1],
  ["missed", (row) => written(row.setpoints_missed, 0, "")],
];

const EXPLAINED = {
  sees: "drones that it tracks and is sure of",
  steps: "of its pilot, as they arrive here",
  load: "how long its steps take over how long they may",
  "link delay": "from here to the drone and back",
  clock: "the drone's wall clock less this computer's",
  missed: "setpoints that its computer was too busy to send in time",
};

async function failure(reply) {
  return reply.ok ? "" : reply.text();
}

// Why no new picture is there; above it may stand an old one.
function captioned(figure, why) {
  const { camera, came } = figure.dataset;
  return came ? `${camera}, ${Math.round((performance.now() - came) / 1000)} s old: no newer one has come` : `${camera}: ${why}`;
}

function apart(seconds) {
  if (seconds === null) return "–";
  const sign = seconds < 0 ? "−" : "+";
  const much = Math.abs(seconds);
  return much < 1 ? `${sign}${(1000 * much).toFixed(0)} ms` : `${sign}${much.toFixed(1)} s`;
}

// The last order, whose it was and how old, and how many were refused.
function ordered({ orders, orders_refused: refused }) {
  const parts = [];
  const [last] = orders;
  if (last) parts.push(`last order: ${last.command}, by ${last.operator} (order ${last.sequence}), ${Math.round(last.age_s)} s ago`);
  if (refused) parts.push(`${refused} orders refused`);
  return parts.join(" · ");
}

export class FleetCards {
  constructor(section, choose, commands, simulation) {
    [this.section, this.choose, this.commands, this.simulation] = [section, choose, commands, simulation];
    this.template = document.getElementById("card");
    this.cards = new Map();
    this.parts = new WeakMap();
    this.order = "";
    this.wanted = new Map();
    this.loading = 0;
    setInterval(() => this.look(), PICTURES_EVERY_MS);
  }

  changed(keys) {
    for (const key of state.order) if (!this.cards.has(key)) this.make(key);
    for (const [key, card] of this.cards) {
      if (state.rows.has(key)) continue;
      card.remove();
      this.cards.delete(key);
    }
    const order = state.order.join(" ");
    if (order !== this.order) {
      this.order = order;
      this.section.append(...state.order.map((key) => this.cards.get(key)));
      keys = state.order;
    }
    for (const key of keys) this.write(key);
  }

  chosen() {
    for (const [key, card] of this.cards) card.classList.toggle("chosen", key === state.chosen);
    const card = this.cards.get(state.chosen);
    if (card && this.section.scrollHeight > this.section.clientHeight) card.scrollIntoView({ block: "nearest" });
  }

  make(key) {
    const card = this.template.content.firstElementChild.cloneNode(true);
    card.dataset.key = key;
    card.style.setProperty("--of-drone", colourOf(key));
    card.querySelector(".name").addEventListener("click", () => this.choose(key));
    const list = card.querySelector("dl");
    for (const [label] of VALUES) {
      const pair = document.createElement("div");
      pair.title = EXPLAINED[label] || "";
      pair.append(document.createElement("dt"), document.createElement("dd"));
      pair.firstChild.textContent = label;
      list.append(pair);
    }
    for (const button of card.querySelectorAll("[data-command]")) {
      button.addEventListener("click", () => this.commands.confirm(button.dataset.command, [key]));
    }
    card.querySelector(".remove").addEventListener("click", () => this.simulation.remove(key));
    card.querySelector(".pictures").hidden = !state.simulation?.by_sight;
    card.querySelector(".look").addEventListener("click", () => {
      const pictures = card.querySelector(".pictures");
      pictures.hidden = !pictures.hidden;
      this.look();
    });
    this.cards.set(key, card);
    const one = (name) => card.querySelector(name);
    this.parts.set(card, {
      name: one(".name span"), state: one(".state"), meaning: one(".meaning"), why: one(".why"), look: one(".look"),
      refusal: one(".refusal"), orders: one(".orders"), identity: one(".identity"), pictures: one(".pictures"), remove: one(".remove"), values: [...list.querySelectorAll("dd")],
      buttons: [...card.querySelectorAll("[data-command]")],
    });
  }

  write(key) {
    const [card, row] = [this.cards.get(key), state.rows.get(key)];
    const parts = this.parts.get(card);
    const [tone, meaning] = STATES[row.state];
    if (card.dataset.tone !== tone) card.dataset.tone = tone;
    put(parts.name, nameOf(key));
    put(parts.state, row.state);
    put(parts.meaning, row.mission ? `${meaning} · mission: ${row.mission}` : meaning);
    const told = row.why.join("\n");
    if (parts.told !== told) {
      parts.told = told;
      parts.why.replaceChildren(...row.why.map((sentence) => {
        const line = document.createElement("li");
        line.textContent = sentence;
        return line;
      }));
    }
    VALUES.forEach(([, text, odd], i) => {
      put(parts.values[i], text(row));
      if (odd) parts.values[i].classList.toggle("odd", Boolean(odd(row)));
    });
    for (const button of parts.buttons) {
      const off = !this.commands.allowed(button.dataset.command, key);
      if (button.disabled !== off) button.disabled = off;
    }
    const blind = !Object.keys(row.cameras).length;
    if (parts.look.disabled !== blind) parts.look.disabled = blind;
    put(parts.refusal, this.simulation.told(key) || this.commands.refusal(key));
    const removable = Boolean(state.simulation) && !this.simulation.isRemoved(key);
    if (parts.remove.hidden === removable) parts.remove.hidden = !removable;
    for (const figure of parts.pictures.children) this.writeSwitch(key, figure);
    put(parts.orders, ordered(row));
    put(parts.identity, row.identities.length > 1 ? `${row.identities.length} drones` : row.identities.join(""));
  }

  // Of a simulated drone's camera.
  writeSwitch(key, figure) {
    const [, button] = figure.children;
    button.hidden = !state.simulation;
    put(button, this.simulation.isOff(key, figure.dataset.camera) ? "Switch on" : "Switch off");
    figure.classList.toggle("off", this.simulation.isOff(key, figure.dataset.camera));
  }

  // New pictures for the cards that show theirs, a few at a time: a browser has six connections to a server, and orders
  // need one.
  look() {
    for (const [key, card] of this.cards) {
      const { pictures } = this.parts.get(card);
      if (pictures.hidden || document.hidden) continue;
      for (const camera of Object.keys(state.rows.get(key).cameras)) {
        const name = JSON.stringify([key, camera]);
        if (!this.wanted.has(name)) this.wanted.set(name, () => this.fetch(key, camera, pictures));
      }
    }
    while (this.loading < PICTURES_AT_ONCE && this.wanted.size) this.loadNext();
  }

  async loadNext() {
    const [[name, load]] = this.wanted;
    this.wanted.delete(name);
    this.loading += 1;
    await load();
    this.loading -= 1;
    if (this.wanted.size) this.loadNext();
  }

  async fetch(key, camera, pictures) {
    let figure = [...pictures.children].find((one) => one.dataset.camera === camera);
    if (!figure) {
      figure = document.createElement("figure");
      figure.dataset.camera = camera;
      figure.append(new Image(), document.createElement("button"), document.createElement("figcaption"));
      figure.children[1].addEventListener("click", () => this.simulation.switch(key, camera));
      this.writeSwitch(key, figure);
      figure.firstChild.alt = `what the camera ${camera} sees`;
      pictures.append(figure);
    }
    const [drone, image] = [key.split("/").map(encodeURIComponent).join("/"), figure.firstChild];
    try {
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
