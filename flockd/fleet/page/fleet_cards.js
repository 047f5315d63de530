// One card a drone, made once and then kept up to date where something has changed.
import { STATES, colourOf, nameOf, put, state, written } from "./fleet_state.js";

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
  if (refused) parts.push(`${refused} order${refused === 1 ? "" : "s"} refused`);
  return parts.join(" · ");
}

export class FleetCards {
  constructor(section, choose, commands, simulation, pictures) {
    [this.section, this.choose, this.commands, this.simulation] = [section, choose, commands, simulation];
    this.pictures = pictures;
    this.template = document.getElementById("card");
    this.cards = new Map();
    this.parts = new WeakMap();
    this.order = "";
  }

  changed(keys) {
    for (const key of state.order) if (!this.cards.has(key)) this.make(key);
    for (const [key, card] of this.cards) {
      if (state.rows.has(key)) continue;
      card.remove();
      this.pictures.hide(this.parts.get(card).pictures);
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
    card.querySelector(".look").addEventListener("click", () => {
      const place = card.querySelector(".pictures");
      place.hidden = !place.hidden;
      if (place.hidden) this.pictures.hide(place);
      else this.pictures.show(place, key);
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
    put(parts.orders, ordered(row));
    put(parts.identity, row.identities.length > 1 ? `${row.identities.length} drones` : row.identities.join(""));
  }
}
