// Commands to drones: confirmed here, sent with the session's token, answered by each drone.
import { byName, nameOf, state } from "./fleet_state.js";

const MEANINGS = {
  hold: ["Hold", "The autopilot holds position: the drone stops, and flockd hands over to it."],
  land: ["Land", "The autopilot lands the drone where it is."],
  resume: ["Resume", "The drone is made ready again; its pilot then selects offboard."],
  goto: ["Send", "It leads the centre of its flock to a place, in metres north and east of its mission’s origin."],
  velocity: ["Fly", "It flies at a velocity for as long as this page sends it, once a second."],
};
const ANSWER_SHOWN_MS = 9000;
const AGAIN_MS = 1000; // half of the time for which a drone flies at an operator's velocity

export class FleetCommands {
  constructor(token) {
    this.token = token;
    this.dialog = document.getElementById("confirm");
    this.form = this.dialog.querySelector("form");
    this.all = document.getElementById("all");
    this.answers = document.getElementById("answers");
    for (const button of this.all.querySelectorAll("button")) {
      button.addEventListener("click", () => this.confirm(button.dataset.command, [...state.order].sort(byName)));
    }
    this.dialog.addEventListener("close", () => this.closed());
    this.flying = null;
  }

  allowed(command, key) {
    const row = state.rows.get(key);
    return state.mayCommand && row.state !== "gone" && row.identities.length < 2 && (row.commands || []).includes(command);
  }

  // Why a drone has no command; empty where it has some.
  refusal(key) {
    const { commands, state: now } = state.rows.get(key);
    if (!state.mayCommand || now === "gone" || (commands || []).length) return "";
    return commands ? "takes no commands: its telemetry.commands allows none" : "takes no commands: it has not told which";
  }

  changed() {
    this.all.hidden = !state.mayCommand || !state.order.length;
    for (const button of this.all.querySelectorAll("button")) {
      button.disabled = !state.order.some((key) => this.allowed(button.dataset.command, key));
      button.title = button.disabled ? "no drone's telemetry.commands allows it" : "";
    }
  }

  // A place of the map, for the chosen drone or for all.
  sendTo([north, east]) {
    const keys = state.chosen ? [state.chosen] : [...state.order].sort(byName);
    const able = keys.filter((key) => this.allowed("goto", key));
    const origins = new Map(able.map((key) => [JSON.stringify(state.rows.get(key).origin_ne), state.rows.get(key).origin_ne]));
    const [origin] = origins.values();
    if (!able.length) return this.tell("No drone takes a goal here.", false);
    if (!origin) return this.tell("A drone has not told from where it counts its goals: write the place with Send.", false);
    if (origins.size > 1) return this.tell("These drones count their goals from different places: choose one of them first.", false);
    const { elements } = this.form;
    [elements.north.value, elements.east.value] = [(north - origin[0]).toFixed(1), (east - origin[1]).toFixed(1)];
    return this.confirm("goto", keys);
  }

  confirm(command, keys) {
    this.command = command;
    this.keys = keys.filter((key) => this.allowed(command, key));
    const left = keys.filter((key) => !this.keys.includes(key));
    const [name, meaning] = MEANINGS[command];
    const who = this.keys.length === 1 ? nameOf(this.keys[0]) : `${this.keys.length} drones`;
    this.dialog.querySelector("h2").textContent = `${name} ${who}${command === "goto" ? " to a place" : ""}?`;
    this.dialog.querySelector(".meaning").textContent = meaning;
    this.dialog.querySelector(".left-out").textContent = left.length ? `Not allowed for ${left.map(nameOf).join(", ")}.` : "";
    this.dialog.querySelector(".send").textContent = `${name} ${who}`;
    for (const [kind, fields] of [["goto", ["north", "east"]], ["velocity", ["v_north", "v_east", "seconds"]]]) {
      this.dialog.querySelector(`.${kind}`).hidden = command !== kind;
      for (const field of fields) [this.form.elements[field].required, this.form.elements[field].disabled] = [command === kind, command !== kind];
    }
    this.dialog.returnValue = "";
    this.form.querySelector("[value=cancel]").formNoValidate = true;
    this.dialog.showModal();
  }

  closed() {
    if (this.dialog.returnValue !== "send") return;
    const [command, keys] = [this.command, this.keys];
    if (this.flying?.keys.some((key) => keys.includes(key))) this.stop();
    this.send(command, keys, command === "goto" ? this.order() : command === "velocity" ? this.velocity() : null);
    if (command === "velocity") this.fly(keys, this.velocity(), 1000 * Number(this.form.elements.seconds.value));
  }

  order() {
    const fields = { north: "north_m", east: "east_m", height: "height_m", speed: "speed_m_s" };
    const given = Object.entries(fields).filter(([field]) => this.form.elements[field].value !== "");
    return Object.fromEntries(given.map(([field, key]) => [key, Number(this.form.elements[field].value)]));
  }

  velocity() {
    const { v_north: north, v_east: east, v_height: height } = this.form.elements;
    const order = { velocity_ne: [Number(north.value), Number(east.value)] };
    return height.value === "" ? order : { ...order, height_m: Number(height.value) };
  }

  // Sends a velocity again until its time is over, a drone refuses it, or one of the drones gets another command.
  fly(keys, order, milliseconds) {
    this.stop();
    const until = performance.now() + milliseconds - AGAIN_MS;
    const timer = setInterval(() => {
      if (performance.now() > until) this.stop();
      else this.send("velocity", keys, order, true);
    }, AGAIN_MS);
    this.flying = { keys, timer };
  }

  stop() {
    if (this.flying) clearInterval(this.flying.timer);
    this.flying = null;
  }

  send(command, drones, order, again = false) {
    return this.post("ask", { drones, command, order }, (replies) => {
      const said = new Map();
      for (const [key, answer] of Object.entries(replies)) {
        const sentence = `${answer.accepted}${answer.sentence}`;
        said.set(sentence, { ...answer, names: [...(said.get(sentence)?.names || []), nameOf(key)] });
      }
      for (const { names, sentence, accepted } of said.values()) {
        if (!again || !accepted) this.tell(`${names.join(", ")}: ${sentence}`, accepted);
        if (again && !accepted) this.stop();
      }
    });
  }

  // What only this server's own page may send.
  async post(path, body, answered) {
    try {
      const reply = await fetch(path, {
        method: "POST",
        priority: "high",
        headers: { "Content-Type": "application/json", "X-Flockd-Token": this.token },
        body: JSON.stringify(body),
      });
      if (!reply.ok) return this.tell(await reply.text(), false);
      answered(await reply.json());
    } catch {
      this.tell("The server cannot be reached: nothing was sent.", false);
    }
    return undefined;
  }

  tell(sentence, accepted) {
    const line = document.createElement("p");
    line.textContent = sentence;
    line.classList.toggle("refused", !accepted);
    this.answers.append(line);
    setTimeout(() => line.remove(), ANSWER_SHOWN_MS);
  }
}
