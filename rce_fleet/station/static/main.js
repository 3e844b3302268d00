// Connects model, view and panel to the station: a WebSocket for changes, HTTP for the operator's requests.

import { GridEditor } from "./grid_editor.js";
import { Fleet } from "./model.js";
import { LayerPanel } from "./layer_panel.js";
import { Layers } from "./layers.js";
import { Panel } from "./panel.js";
import { View } from "./view.js";

let socket = null;
const fleet = new Fleet();
const layers = new Layers((request) => { if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(request)); });
const canvas = document.querySelector("#map");
const view = new View(canvas, fleet, layers);
const panel = new Panel(fleet);
new LayerPanel(fleet, layers);
const badge = document.querySelector("#link");
const message = document.querySelector("#message");
const toolBlock = document.querySelector("#tool-block");
const toolGoal = document.querySelector("#tool-goal");

function say(text, bad = false) {
  message.textContent = text;
  message.className = bad ? "bad" : "";
}

// Send a request; return the answer, or throw an error with its text.
async function ask(method, path, body) {
  const response = await fetch(path, {
    method,
    headers: { "Content-Type": "application/json" },
    body: body === undefined ? undefined : JSON.stringify(body),
  });
  const answer = await response.json();
  if (!response.ok) throw new Error(answer.error ?? response.statusText);
  return answer;
}

async function request(method, path, body) {
  try {
    say((await ask(method, path, body)).message);
  } catch (error) {
    say(error.message, true);
    panel.addEvent(error.message, "bad");
  }
}

function act(cell) {
  if (fleet.selected) {
    const robot = fleet.selected;
    fleet.select(robot);
    return request("PUT", `/api/v1/robots/${robot}/goal`, { cell });
  }
  const blocked = fleet.blocked.has(cell) || fleet.pending.has(cell);
  return request("PUT", `/api/v1/cells/${cell}`, { blocked: !blocked });
}

canvas.addEventListener("click", (event) => {
  if (!fleet.map) return;
  const [x, y] = view.worldAt(event);
  const robot = fleet.robotAt(x, y, 0.35 * fleet.map.cell_size);
  if (robot) return fleet.select(robot.id);
  const cell = fleet.cellAt(x, y);
  if (cell !== null) act(cell);
});

canvas.addEventListener("pointermove", (event) => {
  if (fleet.map) view.cursor = fleet.cellAt(...view.worldAt(event));
});
canvas.addEventListener("pointerleave", () => { view.cursor = null; });

canvas.addEventListener("keydown", (event) => {
  if (!fleet.map) return;
  const { rows, columns } = fleet.map;
  const steps = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: columns, ArrowDown: -columns };
  if (event.key in steps) {
    const next = (view.cursor ?? 0) + steps[event.key];
    if (next >= 0 && next < rows * columns) view.cursor = next;
  } else if (event.key === "Enter" && view.cursor !== null) {
    act(view.cursor);
  } else {
    return;
  }
  event.preventDefault();
});

const editor = new GridEditor(fleet, ask);
view.editor = editor;
editor.addEventListener("taken", ({ detail }) => say(detail));

toolBlock.addEventListener("click", () => { if (fleet.selected) fleet.select(fleet.selected); });

fleet.addEventListener("selected", () => {
  toolBlock.setAttribute("aria-pressed", fleet.selected === null);
  toolGoal.setAttribute("aria-pressed", fleet.selected !== null);
  toolGoal.disabled = fleet.selected === null;
  toolGoal.textContent = fleet.selected ? `Send ${fleet.selected}: click its goal` : "Pick a robot to send it";
});

fleet.addEventListener("news", ({ detail }) => panel.addEvent(detail.text, detail.tone));

// A station that was restarted does not know which layers are shown, and refuses them until it knows the robots.
fleet.addEventListener("state", () => layers.request());

fleet.addEventListener("map", () => {
  canvas.style.aspectRatio = `${fleet.map.columns} / ${fleet.map.rows}`;
  view.cursor = null;
});

async function identify() {
  const response = await fetch("/api/v1/me");
  if (response.status === 401) return location.replace("/login");
  if (!response.ok) return say((await response.json()).error, true);
  const person = await response.json();
  document.querySelector("#person").textContent = person.logged_in ? `${person.name} (${person.role})` : "";
  document.querySelector("#logout").hidden = !person.logged_in;
  editor.form.hidden = !person.steers;
  if (!person.steers) {
    for (const tool of [toolBlock, toolGoal]) tool.hidden = true;
    document.querySelector("#hint").textContent = `Your role, ${person.role}, looks and does not steer.`;
  }
}

document.querySelector("#logout").addEventListener("click", async () => {
  await fetch("/api/v1/login", { method: "DELETE" });
  location.replace("/login");
});

const LOGIN_ENDED = 1008;

function connect(delay = 500) {
  const opening = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/v1/live?changes=1`);
  opening.binaryType = "arraybuffer";
  socket = opening;
  let opened = false;
  opening.addEventListener("open", () => {
    opened = true;
    badge.textContent = "live";
    badge.classList.add("live");
    layers.request();
  });
  opening.addEventListener("message", (event) => {
    if (event.data instanceof ArrayBuffer) return layers.takeFrame(event.data);
    const received = JSON.parse(event.data);
    if (received.type === "layer") return layers.take(received);
    fleet.apply(received);
    // A change is missing; the next connection begins with the complete state.
    if (received.type === "changes" && fleet.isBehind) opening.close();
  });
  opening.addEventListener("close", ({ code }) => {
    if (code === LOGIN_ENDED) return location.replace("/login");
    badge.textContent = "connecting";
    badge.classList.remove("live");
    setTimeout(connect, delay * (0.5 + Math.random()), opened ? 500 : Math.min(2 * delay, 8000));
  });
}

identify();
connect();

// For automated tests of the page.
window.rceFleet = { fleet, layers, view, editor };
