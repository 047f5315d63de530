// Curves of the last minutes, drawn by Plotly, which is loaded when the page has its first drones.
import { KEEP_S, byName, colourOf, nameOf, recent, state } from "./fleet_state.js";

const MEASURES = {
  height: ["height, m", 1],
  speed: ["speed, m/s", 1],
  battery: ["battery, %", 100],
  load: ["load, % of the time for a step", 100],
  temperature: ["temperature, °C", 1],
  rate: ["steps a second", 1],
  delay: ["link there and back, ms", 1],
  clock: ["drone's clock less this computer's, s", 1],
};
const EVERY_MS = 2000;
const MOST_POINTS = 2000; // of a line, with two a second in the history
const FEW = 8; // more drones than this are one grey bundle, with the chosen one in front

export class FleetCurves {
  constructor(section) {
    this.section = section;
    this.plot = section.querySelector(".plot");
    this.select = section.querySelector("select");
    for (const [name, [label]] of Object.entries(MEASURES)) this.select.add(new Option(label, name));
    this.select.addEventListener("input", () => this.draw());
    this.loading = null;
    this.visible = true;
    new IntersectionObserver(([entry]) => { this.visible = entry.isIntersecting; }).observe(section);
    setInterval(() => this.draw(), EVERY_MS);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  load() {
    this.loading ||= new Promise((loaded, failed) => {
      const script = document.createElement("script");
      script.src = "plotly.js";
      script.onload = loaded;
      script.onerror = failed;
      document.head.append(script);
    });
    return this.loading;
  }

  async draw() {
    if (!state.order.length || !this.visible || document.hidden) return;
    await this.load();
    const style = getComputedStyle(document.documentElement);
    const ink = (name) => style.getPropertyValue(`--${name}`).trim();
    const axis = { gridcolor: ink("grid"), zeroline: false, linecolor: ink("line"), fixedrange: true };
    const layout = {
      margin: { l: 44, r: 10, t: 6, b: 30 },
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: ink("muted"), size: 11 },
      showlegend: false,
      hovermode: "closest",
      xaxis: { ...axis, range: [-this.seconds(), 0], title: { text: "seconds before now", standoff: 4 } },
      yaxis: { ...axis, rangemode: ["clock", "temperature"].includes(this.select.value) ? "normal" : "tozero" },
    };
    const traces = this.traces(ink);
    if (!traces.some((trace) => trace.y.some((value) => value !== null))) {
      layout.annotations = [{ text: "No drone has sent this yet.", xref: "paper", yref: "paper", x: 0.5, y: 0.5, showarrow: false }];
    }
    window.Plotly.react(this.plot, traces, layout, { displayModeBar: false, displaylogo: false, responsive: true });
  }

  // As long as there is something to show, and a minute at least.
  seconds() {
    const begins = state.order.map((key) => recent(key, KEEP_S)[0]).filter(Boolean).map((row) => row[0]);
    return Math.max(60, state.now - Math.min(state.now, ...begins));
  }

  traces(ink) {
    const keys = [...state.order].sort(byName);
    const own = keys.length <= FEW ? keys : keys.filter((key) => key === state.chosen);
    const bundle = keys.filter((key) => !own.includes(key));
    const traces = own.map((key) => ({ ...this.points([key]), line: { color: colourOf(key), width: 1.6 }, name: nameOf(key) }));
    if (bundle.length) {
      traces.unshift({ ...this.points(bundle), line: { color: ink("muted"), width: 0.7 }, opacity: 0.5, hoverinfo: "skip" });
    }
    return traces.map((trace) => ({ type: "scatter", mode: "lines", connectgaps: false, ...trace }));
  }

  // Of several drones one line with gaps between them: many lines cost much more to draw.
  points(keys) {
    const [x, y] = [[], []];
    const [column, factor] = [state.columns[this.select.value], MEASURES[this.select.value][1]];
    const every = Math.ceil((keys.length * 2 * KEEP_S) / MOST_POINTS);
    for (const key of keys) {
      recent(key, KEEP_S).forEach((row, i) => {
        if (i % every) return;
        x.push(row[0] - state.now);
        y.push(row[column] === null ? null : factor * row[column]);
      });
      x.push(null);
      y.push(null);
    }
    return { x, y };
  }
}
