// Commands to drones: confirmed here, sent with the session's token, answered by each drone.
import { byName, nameOf, state } from "./fleet_state.js";

const MEANINGS = {
  hold: ["Hold", "The autopilot holds position: the drone stops, and flockd hands over to it."],
  land: ["Land", "The autopilot lands the drone where it is."],
  resume: ["Resume", "The drone is made ready again; its pilot then selects offboard."],
  goto: ["Send", "It leads the centre of its flock to a place, in metres north and east of its mission’s origin."],
};
const ANSWER_SHOWN_MS = 9000;

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
  }

  allowed(command, key) {
    const row = state.rows.get(key);
    return state.mayCommand && row.state !== "gone" && row.identities.length < 2 && (row.commands || []).includes(command);
  }

  // Why a drone has no command; empty where it has some.
  refusal(key) {
    const { commands, state: now } = state.rows.get(key);
    if (!state.live || !state.mayCommand || now === "gone" || (commands || []).length) return "";
    return commands ? "takes no commands: its telemetry.commands allows none" : "takes no commands: it has not told which";
  }

  changed() {
    this.all.hidden = !state.mayCommand || !state.order.length;
    for (const button of this.all.querySelectorAll("button")) {
      button.disabled = !state.order.some((key) => this.allowed(button.dataset.command, key));
      button.title = button.disabled ? "no drone's telemetry.commands allows it" : "";
    }
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
    this.dialog.querySelector("fieldset").hidden = command !== "goto";
    for (const field of ["north", "east"]) this.form.elements[field].required = command === "goto";
    this.dialog.returnValue = "";
    this.form.querySelector("[value=cancel]").formNoValidate = true;
    this.dialog.showModal();
  }

  closed() {
    if (this.dialog.returnValue === "send") this.send(this.command, this.keys, this.command === "goto" ? this.order() : null);
  }

  order() {
    const fields = { north: "north_m", east: "east_m", height: "height_m", speed: "speed_m_s" };
    const given = Object.entries(fields).filter(([field]) => this.form.elements[field].value !== "");
    return Object.fromEntries(given.map(([field, key]) => [key, Number(this.form.elements[field].value)]));
  }

  async send(command, drones, order) {
    try {
      const reply = await fetch("ask", {
        method: "POST",
        priority: "high",
        headers: { "Content-Type": "application/json", "X-Flockd-Token": this.token },
        body: JSON.stringify({ drones, command, order }),
      });
      if (!reply.ok) return this.tell(await reply.text(), false);
      const answers = Object.entries(await reply.json());
      const said = new Map();
      for (const [key, answer] of answers) {
        const sentence = `${answer.accepted}${answer.sentence}`;
        said.set(sentence, { ...answer, names: [...(said.get(sentence)?.names || []), nameOf(key)] });
      }
      for (const { names, sentence, accepted } of said.values()) this.tell(`${names.join(", ")}: ${sentence}`, accepted);
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
