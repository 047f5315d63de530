// What the page knows of the fleet, and how values are written.

export const state = {
  mayCommand: false,
  now: 0,
  rows: new Map(),
  order: [],
  fleets: new Set(),
  history: new Map(),
  columns: {},
  chosen: null,
  simulation: null,
};

const COLOURS = ["#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#a39400", "#808890"];
const numbers = new Map();

// Up to eight drones have a colour each that colour-blind readers can tell apart.
export function colourOf(key) {
  const number = numbers.get(key);
  return number < COLOURS.length ? COLOURS[number] : `hsl(${(number * 137.5) % 360} 55% 52%)`;
}

// drone2 before drone10.
export function byName(one, other) {
  return one.localeCompare(other, "en", { numeric: true });
}

export const STATES = {
  idle: ["calm", "waits on the ground or is flown by somebody else"],
  ready: ["calm", "ready: the pilot may switch to offboard"],
  normal: ["good", "flies with the flock"],
  degraded: ["fair", "flies on, slower"],
  hover: ["bad", "stands still in the air"],
  asking: ["bad", "asks its autopilot to take over"],
  silent: ["bad", "handed over: its autopilot flies"],
  quiet: ["bad", "publishes nothing"],
  gone: ["bad", "no contact"],
};

// A fleet's name is shown where there are several.
export function nameOf(key) {
  return state.fleets.size > 1 ? key : key.split("/")[1];
}

export function placeOf(row) {
  if (!row.position_ne) return null;
  const home = row.home_ne || [0, 0];
  return [row.position_ne[0] + home[0], row.position_ne[1] + home[1]];
}

// Of one that is silent now.
export function lastPlaceOf(key) {
  const last = recent(key, KEEP_S).findLast((row) => row[1] !== null);
  return last ? [last[1], last[2]] : null;
}

export function take(message) {
  state.now = message.time_s;
  state.order = message.order;
  state.fleets = new Set(state.order.map((one) => one.split("/")[0]));
  for (const key of [...message.order].sort(byName)) if (!numbers.has(key)) numbers.set(key, numbers.size);
  for (const [key, row] of Object.entries(message.rows)) {
    state.rows.set(key, row);
    remember(key, row);
  }
  for (const key of state.rows.keys()) if (!message.order.includes(key)) state.rows.delete(key);
}

export const KEEP_S = 300;
const EVERY_S = 0.45;

function remember(key, row) {
  const kept = state.history.get(key) || [];
  state.history.set(key, kept);
  if (kept.length && state.now - kept[kept.length - 1][0] < EVERY_S) return;
  const place = placeOf(row) || [null, null];
  kept.push([
    state.now, ...place, row.height_m, row.speed_m_s, row.battery_share, row.load, row.temperature_c, row.rate_hz,
    row.delay_ms, row.clock_s,
  ]);
  while (kept.length && kept[0][0] < state.now - KEEP_S) kept.shift();
}

// The rows of a drone's history from some seconds ago until now.
export function recent(key, seconds) {
  const kept = state.history.get(key) || [];
  const [first, last] = [after(kept, state.now - seconds), after(kept, state.now)];
  return kept.slice(first, last);
}

function after(kept, time) {
  let [low, high] = [0, kept.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (kept[middle][0] <= time) low = middle + 1;
    else high = middle;
  }
  return low;
}

export function written(value, digits, unit) {
  return value === null || value === undefined ? "–" : `${value.toFixed(digits)}${unit}`;
}

const texts = new WeakMap();

// Writes an element's text where it has changed.
export function put(element, text) {
  if (texts.get(element) === text) return;
  texts.set(element, text);
  element.textContent = text;
}
