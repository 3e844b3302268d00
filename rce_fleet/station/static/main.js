// Connects the parts of the page: the fleet, the map, the panels, and what the operator does.

import { Actions } from "./actions.js";
import { Attention } from "./attention.js";
import { AuditPanel } from "./audit_panel.js";
import { BlockFields } from "./block_fields.js";
import { describeCell } from "./cell_text.js";
import { Connection } from "./connection.js";
import { Drive } from "./drive.js";
import { Gestures } from "./gestures.js";
import { GridEditor } from "./grid_editor.js";
import { LayerPanel } from "./layer_panel.js";
import { Layers } from "./layers.js";
import { Figures } from "./figures.js";
import { MastersPanel } from "./masters_panel.js";
import { Fleet } from "./model.js";
import { Panel } from "./panel.js";
import { Presses } from "./presses.js";
import { Replay } from "./replay.js";
import { Operator, ask } from "./requests.js";
import { RobotCard } from "./robot_card.js";
import { RobotsTable } from "./robots_table.js";
import { TasksPanel } from "./tasks_panel.js";
import { fillTexts, t } from "./texts.js";
import { startTheme } from "./theme.js";
import { Tools } from "./tools.js";
import { View } from "./view.js";
import { World3d } from "./view3d.js";
import { WorldPanel } from "./world_panel.js";
import { Work } from "./work.js";
import { ZoneForm } from "./zone_form.js";

const at = (selector) => document.querySelector(selector);
const IDENTIFY_AGAIN_MS = 5000;
const WIDE = 1.3; // a map that is this much wider than high is above the view of the world, not beside it

fillTexts();
const fleet = new Fleet();
const layers = new Layers((request) => connection.send(request));
const view = new View(at("#stage"), fleet, layers);
const panel = new Panel(fleet);
const badge = at("#link");
let refusal = "";
const connection = new Connection(fleet, layers, (live) => {
  badge.textContent = t(live ? "link.live" : "link.connecting");
  badge.classList.toggle("live", live);
  if (live && refusal && message.textContent === refusal) say("");
  identify();
  markStale();
}, (text) => say(refusal = text, true));
const message = at("#message");

// What the map shows is old.
function markStale() {
  at("#stages").classList.toggle("stale", !connection.isLive || fleet.plannerAwaySince !== null);
}

function say(text, bad = false) {
  message.textContent = text;
  message.className = bad ? "bad" : "";
}

const operator = new Operator(say, (text) => panel.addEvent(text, "bad"));
const work = new Work(fleet);
const actions = new Actions(fleet, operator, work);
const tools = new Tools(view, fleet, actions);
const drive = new Drive(fleet);
const gestures = new Gestures(view.canvas, view.camera, tools);
new Presses();
new RobotsTable(fleet, (robot) => answer("show", robot));
new AuditPanel(fleet);
new LayerPanel(fleet, layers, view);
new Figures();
const world = new World3d(at("#world"), view.scene, fleet);
view.changed = () => world.wake();
const worldPanel = new WorldPanel(world, fleet, operator);
const masters = new MastersPanel(fleet, operator);
const replay = new Replay(view, fleet, say);
tools.isPast = () => replay.at !== null;
new ZoneForm(tools, actions, work);
new BlockFields(tools);
const tasks = new TasksPanel(work, actions, fleet);

const releaseAll = () => actions.emergencyStop(null, false);

// An answer to a task's exception.
function answerTask(name, task, cell) {
  const answers = {
    raise: () => actions.raise(task, 100),
    cancel: () => actions.cancelTask(task),
    loadAt: () => actions.settleLoad(task, cell),
    loadPlace: () => tools.chooseLoad(task),
    loadLost: () => actions.settleLoad(task, null),
  };
  return answers[name]();
}

// An answer to an exception, or a button of a robot's card.
function answer(name, robot) {
  const task = fleet.robots.get(robot)?.task;
  const answers = {
    show: () => {
      if (!fleet.robots.has(robot)) return;
      if (fleet.selected !== robot) fleet.select(robot);
      const { pose } = fleet.robots.get(robot);
      if (pose) view.camera.centre(pose.x, pose.y);
    },
    stop: () => actions.emergencyStop(robot, true),
    release: () => actions.emergencyStop(robot, false),
    stopAll: () => actions.emergencyStop(null, true),
    releaseAll,
    drive: () => drive.begin(robot),
    localize: () => {
      if (fleet.selected !== robot) fleet.select(robot);
      tools.choose("pose");
    },
    raise: () => task && actions.raise(task, 100),
  };
  return (answers[name] ?? (() => actions[name](robot)))();
}

const attention = new Attention(fleet, work, answer, answerTask);
const card = new RobotCard(fleet, answer);

view.canvas.addEventListener("keydown", (event) => {
  if (!fleet.map) return;
  if (gestures.key(event)) return event.preventDefault();
  const { rows, columns } = fleet.map;
  const steps = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: columns, ArrowDown: -columns };
  if (event.key in steps) {
    const next = (view.cursor ?? 0) + steps[event.key];
    if (next >= 0 && next < rows * columns) view.cursorCell = next;
    if (view.cursor !== null) at("#cursor-text").textContent = describeCell(fleet, work.zones, view.cursor);
  } else if (event.key === "Enter" && view.cursor !== null) tools.use(view.cursor);
  else if (event.key === "Escape") tools.choose("act");
  else return;
  event.preventDefault();
});

// Who blocked the cell under the pointer, and why.
view.canvas.addEventListener("pointermove", () => {
  const { cursor } = view;
  const isBlocked = cursor !== null && replay.at === null && !fleet.walls.has(cursor) && (fleet.blocked.has(cursor) || fleet.pending.has(cursor));
  const text = isBlocked ? describeCell(fleet, work.zones, cursor) : "";
  if (view.canvas.title !== text) view.canvas.title = text;
});

at("#zoom-in").addEventListener("click", () => view.camera.zoom(1.5));
at("#zoom-out").addEventListener("click", () => view.camera.zoom(1 / 1.5));
at("#zoom-fit").addEventListener("click", () => view.camera.fit());

for (const button of document.querySelectorAll("[data-tool]")) button.addEventListener("click", () => tools.choose(button.dataset.tool));

function drawTools() {
  for (const button of document.querySelectorAll("[data-tool]")) button.setAttribute("aria-pressed", button.dataset.tool === tools.tool);
  at("#hint").textContent = tools.hint;
}
tools.addEventListener("chosen", drawTools);
fleet.addEventListener("selected", drawTools);
replay.addEventListener("change", drawTools);
drawTools();

// What holds for the whole fleet.

at("#fleet-pause").addEventListener("click", () => actions.setMode("paused"));
at("#fleet-resume").addEventListener("click", () => actions.setMode("automatic"));
at("#stop-all").addEventListener("click", () => actions.emergencyStop(null, true));
at("#release-all").addEventListener("click", releaseAll);
for (const type of ["state", "changes"]) fleet.addEventListener(type, () => {
  const { mode } = fleet;
  const isPaused = mode !== "automatic";
  if (at("#mode").hidden === isPaused) {
    at("#mode").hidden = at("#fleet-resume").hidden = !isPaused;
    at("#fleet-pause").hidden = isPaused;
  }
  if (isPaused) at("#mode").textContent = t(`mode.${mode}`);
});
fleet.addEventListener("control", () => { at("#release-all").hidden = fleet.stoppedBy === null && !Object.keys(fleet.stopped).length; });
fleet.addEventListener("planner", () => {
  at("#planner").hidden = fleet.plannerAwaySince === null;
  markStale();
});
at("#undo").addEventListener("click", () => operator.undo());
operator.addEventListener("acted", () => {
  const { undoable } = operator;
  at("#undo").disabled = undoable === null;
  at("#undo").title = undoable === null ? "" : t("undo.what", { label: undoable });
  work.refresh();
});
work.addEventListener("change", () => {
  view.scene.zones = work.zones;
  view.touch("cells");
});
document.addEventListener("keydown", (event) => {
  if ((event.ctrlKey || event.metaKey) && event.key === "z" && !event.target.closest("input, dialog")) operator.undo();
});

const editor = new GridEditor(fleet, ask);
view.editor = editor;
editor.addEventListener("taken", ({ detail }) => say(detail));

fleet.addEventListener("news", ({ detail }) => panel.addEvent(detail.text, detail.tone));
// A station that was restarted does not know which layers are shown, and refuses them until it knows the robots.
fleet.addEventListener("state", () => layers.request());
fleet.addEventListener("map", () => {
  at("#stage").style.aspectRatio = `${fleet.map.columns} / ${fleet.map.rows}`;
  at("#stages").classList.toggle("wide", fleet.map.columns > WIDE * fleet.map.rows);
  view.cursorCell = null;
});

// Asked whenever the connection opens, or does not: browsers do not tell that it was refused for want of a login.
let identified = 0;
async function identify() {
  const number = ++identified;
  let response, person;
  try {
    response = await fetch("/api/v1/me");
    if (response.status === 401) return location.replace("/login");
    person = await response.json();
  } catch {
    return; // the station is away, or its answer was cut off
  }
  if (number !== identified) return;
  if (!response.ok) {
    say(person.error, true);
    if (connection.isLive) setTimeout(() => { if (number === identified) identify(); }, IDENTIFY_AGAIN_MS);
    return;
  }
  actions.user = person.name;
  at("#person").textContent = person.logged_in ? `${person.name} (${person.role})` : "";
  at("#logout").hidden = !person.logged_in;
  editor.form.hidden = !person.steers;
  for (const part of [tools, tasks, attention, card, worldPanel, masters]) part.steers = person.steers;
  for (const part of document.querySelectorAll(".steer")) part.hidden = !person.steers;
  card.draw();
  drawTools();
}

at("#logout").addEventListener("click", async () => {
  await fetch("/api/v1/login", { method: "DELETE" });
  location.replace("/login");
});

startTheme(at("#theme"), () => {
  view.readColours();
  world.readColours(view.colour);
});
identify();
connection.open();

// For automated tests of the page.
window.rceFleet = { fleet, layers, view, editor, tools, actions, operator, work, drive, replay, world, worldPanel, traffic: connection.traffic };
