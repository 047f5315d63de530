// The fleet page: takes what the server sends, and keeps map, cards, curves and events up to date.
import { FleetCards } from "./fleet_cards.js";
import { FleetCommands } from "./fleet_commands.js";
import { FleetCurves } from "./fleet_curves.js";
import { FleetMap } from "./fleet_map.js";
import { FleetPictures, FleetSight } from "./fleet_pictures.js";
import { SimulationControls } from "./fleet_simulation.js";
import { STATES, nameOf, put, state, take } from "./fleet_state.js";

const token = document.querySelector("meta[name=token]").content;
const AGAIN_MS = 1000;
const AGAIN_SLOWLY_MS = 5000;
const OTHER_KEY = "The server was started again with another key: open the address that it printed. Started with --key-file FILE it keeps its key, and open pages go on by themselves.";
const SILENT_MS = 5000;
const EVENTS_SHOWN = 200;

const commands = new FleetCommands(token);
const map = new FleetMap(document.getElementById("map"), choose, (place) => commands.sendTo(place));
const simulation = new SimulationControls(document.getElementById("simulation"), commands);
const pictures = new FleetPictures(simulation);
const cards = new FleetCards(document.getElementById("cards"), choose, commands, simulation, pictures);
const sight = new FleetSight(document.getElementById("sight"), choose, pictures);
const curves = new FleetCurves(document.getElementById("curves"));
const summary = document.getElementById("summary");
const trouble = document.getElementById("trouble");
const notes = document.getElementById("notes");
let [socket, heard, told] = [null, 0, null];

function choose(key) {
  state.chosen = key === state.chosen ? null : key;
  cards.chosen();
  sight.changed();
  map.changed();
  curves.draw();
}

async function connect() {
  socket = new WebSocket(`ws://${location.host}/live`);
  socket.onopen = () => socket.send(JSON.stringify({ token }));
  socket.onmessage = async ({ data }) => {
    heard = performance.now();
    const message = JSON.parse(data);
    if (message.kind === "hello") await greeted(message);
    else show(message);
  };
  socket.onclose = () => lost();
}

// Tries again for ever: the page goes on by itself as soon as the server is back and knows its key.
async function lost() {
  const [sentence, wait] = await whyLost();
  complain(sentence);
  setTimeout(connect, wait);
}

async function whyLost() {
  try {
    const reply = await fetch("fleet_page.css", { method: "HEAD" });
    if (reply.status === 403) return [OTHER_KEY, AGAIN_SLOWLY_MS];
    return ["The server closed the connection, and is asked again: too many pages may be open. What is shown is old.", AGAIN_MS];
  } catch {
    return ["The server cannot be reached, and is asked again every second: what is shown is old. If it was stopped, start it again.", AGAIN_MS];
  }
}

async function greeted(hello) {
  complain("");
  document.querySelector("#events ol").replaceChildren();
  state.mayCommand = hello.may_command;
  const reply = await fetch("history");
  if (!reply.ok) return complain(await reply.text());
  const { columns, drones } = await reply.json();
  state.columns = Object.fromEntries(columns.map((name, i) => [name, i]));
  state.history = new Map(Object.entries(drones));
  return undefined;
}

function show(message) {
  const first = !state.order.length && message.order.length;
  const before = state.simulation;
  if (simulation.take(message.simulation)) state.history.clear();
  take(message);
  const changed = JSON.stringify(before) !== JSON.stringify(state.simulation);
  cards.changed(changed ? state.order : Object.keys(message.rows));
  if (changed) pictures.changed();
  sight.changed();
  commands.changed();
  map.changed();
  showSummary();
  showEvents(message);
  put(notes, message.notes.join(" "));
  if (first) curves.draw();
}

function showSummary() {
  const fleets = [...state.fleets].sort().join(", ") || "Fleet";
  document.title = `${fleets} - flockd`;
  document.querySelector("h1").textContent = fleets;
  const counts = new Map();
  for (const key of state.order) {
    const now = state.rows.get(key).state;
    counts.set(now, (counts.get(now) || 0) + 1);
  }
  const text = [...counts].map(([name, count]) => `${count} ${name}`).join(" ");
  if (text === told) return;
  told = text;
  const parts = [...counts].map(([name, count]) => {
    const part = document.createElement("b");
    part.className = STATES[name][0];
    part.textContent = `${count} ${name}`;
    return part;
  });
  const drones = `${state.order.length} drone${state.order.length === 1 ? "" : "s"}`;
  summary.replaceChildren(parts.length ? `${drones}: ` : "No drone was heard yet.", ...parts.flatMap((part, i) => (i ? [", ", part] : [part])));
}

function showEvents({ events }) {
  const list = document.querySelector("#events ol");
  for (const event of events.slice(-EVENTS_SHOWN)) showEvent(list, event);
  while (list.children.length > EVENTS_SHOWN) list.lastChild.remove();
}

// What a drone says again and again, such as an order that is repeated, is one line with a count.
function showEvent(list, event) {
  const said = `${event[1]} ${event[2].replace(/order \d+/, "order")}`;
  const [line, newest] = [eventLine(event), list.firstChild];
  line.dataset.said = said;
  if (newest && newest.dataset.said === said) {
    line.dataset.times = Number(newest.dataset.times || 1) + 1;
    put(line.children[2], `${event[2]} (${line.dataset.times} times)`);
    newest.remove();
  }
  list.prepend(line);
}

function eventLine([time, key, sentence]) {
  const line = document.createElement("li");
  line.append(document.createElement("time"), document.createElement("b"), document.createElement("span"));
  const clock = new Date(Date.now() - 1000 * (state.now - time));
  const parts = [clock.getHours(), clock.getMinutes(), clock.getSeconds()];
  put(line.children[0], parts.map((part) => String(part).padStart(2, "0")).join(":"));
  put(line.children[1], nameOf(key));
  put(line.children[2], sentence);
  return line;
}

function complain(sentence) {
  trouble.hidden = !sentence;
  put(trouble, sentence);
}

setInterval(() => {
  if (socket.readyState !== WebSocket.OPEN) return;
  if (heard && performance.now() - heard > SILENT_MS) complain("Nothing came from the server for seconds: what is shown is old.");
  else if (heard) complain("");
}, AGAIN_MS);
connect();
