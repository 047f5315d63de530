// Controls of a simulation that is flown live. Where the drones are real there is none, and nothing here is shown.
import { nameOf, put, state } from "./fleet_state.js";

const BEHIND = 0.9; // of the wanted speed

function paceOf({ paused, speed, speed_reached: reached, time_s: time, by_sight: bySight }) {
  if (paused) return " · stands still";
  if (reached === null) return bySight && !time ? " · loads networks and builds the world" : "";
  return ` · ${reached.toFixed(2)} × real time${reached < BEHIND * speed ? ", as fast as this computer can" : ""}`;
}

export class SimulationControls {
  constructor(form, commands) {
    [this.form, this.commands] = [form, commands];
    const { pause, restart, speed, gusts } = form.elements;
    [this.pause, this.speed, this.gusts] = [pause, speed, gusts];
    this.output = form.querySelector("output");
    this.written = form.querySelector(".gusts");
    form.addEventListener("submit", (event) => event.preventDefault());
    pause.addEventListener("click", () => this.ask(state.simulation.paused ? "go_on" : "pause"));
    restart.addEventListener("click", () => this.ask("restart"));
    speed.addEventListener("change", () => this.ask("speed", { factor: Number(speed.value) }));
    gusts.addEventListener("input", () => this.write(Number(gusts.value)));
    gusts.addEventListener("change", () => this.ask("gusts", { gust_m_s: Number(gusts.value) }));
  }

  // Whether another flight has begun since the last message.
  take(simulation) {
    const before = state.simulation;
    state.simulation = simulation;
    this.form.hidden = !simulation;
    if (!simulation) return false;
    put(this.pause, simulation.paused ? "Go on" : "Pause");
    if (!before || before.speed !== simulation.speed) this.speed.value = String(simulation.speed);
    if (!before || before.gust_m_s !== simulation.gust_m_s) this.gusts.value = simulation.gust_m_s;
    if (document.activeElement !== this.gusts) this.write(simulation.gust_m_s);
    put(this.output, `${simulation.time_s.toFixed(1)} s${paceOf(simulation)}`);
    return Boolean(before) && before.flight !== simulation.flight;
  }

  write(gust) {
    put(this.written, `${gust.toFixed(1)} m/s`);
  }

  ask(control, value = null) {
    return this.commands.post("simulate", { control, value }, (answer) => this.commands.tell(answer.sentence, answer.accepted));
  }

  isOff(key, camera) {
    return Boolean(state.simulation?.cameras_off[key.split("/")[1]]?.includes(camera));
  }

  isRemoved(key) {
    return Boolean(state.simulation?.removed.includes(key.split("/")[1]));
  }

  switch(key, camera) {
    return this.ask("camera", { drone: key.split("/")[1], camera, works: this.isOff(key, camera) });
  }

  remove(key) {
    return this.ask("remove", { drone: key.split("/")[1] });
  }

  // Of a drone's card; empty where there is nothing to say.
  told(key) {
    return this.isRemoved(key) ? `${nameOf(key)} was taken out of the simulation; Restart brings it back.` : "";
  }
}
