// The engine's state: containers with usage, nodes, advice, and connections with rates; or the nodes of a ROS graph.

import { t } from "./texts.js";

const TONE = {
  running: "good", connected: "good", placed: "warn", starting: "warn", requested: "warn", waiting: "warn",
  absent: "warn", draining: "warn", away: "bad", degraded: "warn", stopped: "warn", stopping: "warn", failed: "bad", lost: "bad", stuck: "bad",
};
const NEARLY_FULL = 0.9;
const MOST_CONNECTIONS = 40; // that are listed, the busiest first

export function element(tag, text = "", className = "") {
  const made = document.createElement(tag);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

function stateLine(label, state, detail = "") {
  const item = element("li");
  item.append(element("span", `${label} `), element("span", state, TONE[state] ?? "quiet"));
  if (detail) item.append(element("span", ` ${detail}`, "quiet"));
  return item;
}

// A bar for the used share of a limit; only text without a limit.
function bar(name, used, limit, words) {
  const line = element("div", "", "use");
  line.append(element("span", name, "quiet"));
  if (limit > 0) {
    const meter = element("meter");
    Object.assign(meter, { min: 0, max: limit, low: 0.75 * limit, high: NEARLY_FULL * limit, optimum: 0, value: used });
    meter.setAttribute("aria-label", `${name}: ${words}`);
    line.append(meter);
  }
  line.append(element("span", words));
  return line;
}

const megabytes = (count) => t("unit.megabytes", { count: Math.round(count / 2 ** 20) });
const percent = (share) => t("unit.percent", { percent: Math.round(100 * share) });
const of = (used, limit) => t("engine.of", { used, limit });
const rate = (messages, bytes, key = "engine.rate") => t(key, { messages: messages < 10 ? messages.toFixed(1) : Math.round(messages), kilobytes: (bytes / 1000).toFixed(bytes < 10000 ? 1 : 0) });

function uses(usage) {
  const found = document.createDocumentFragment();
  const cpu = usage.cpu_limit ? of(percent(usage.cpu), percent(usage.cpu_limit)) : percent(usage.cpu);
  const memory = usage.memory_limit ? of(megabytes(usage.memory), megabytes(usage.memory_limit)) : megabytes(usage.memory);
  found.append(bar(t("engine.cpu"), usage.cpu, usage.cpu_limit, cpu), bar(t("engine.memory"), usage.memory, usage.memory_limit, memory));
  const troubles = [];
  if (usage.restarts) troubles.push(usage.restarts === 1 ? t("engine.restart") : t("engine.restarts", { count: usage.restarts }));
  if (usage.oom_kills) troubles.push(usage.oom_kills === 1 ? t("engine.oom") : t("engine.ooms", { count: usage.oom_kills }));
  if (troubles.length) found.append(element("div", troubles.join(", "), "use warn"));
  return found;
}

function adviceLine(advice) {
  const line = element("p", "", "advice");
  line.append(element("span", `${advice.about}: `, "warn"), element("span", `${advice.text} `), element("code", advice.command));
  return line;
}

function containerItem(container) {
  const place = container.moving_to ? t("engine.moving", { machine: container.machine, to: container.moving_to }) : container.machine;
  const item = stateLine(container.tag, container.state, place);
  if (container.usage) item.append(uses(container.usage));
  for (const advice of container.advice ?? []) item.append(adviceLine(advice));
  const nodes = element("ul");
  for (const node of container.nodes) nodes.append(stateLine(node.tag, node.state, node.detail));
  item.append(nodes);
  return item;
}

// A machine and its reserved resources.
function machineItem(machine) {
  const state = !machine.connected ? "away" : machine.draining ? "draining" : "connected";
  const item = stateLine(machine.machine, state, t("engine.containers", { count: machine.containers }));
  if (machine.slots) item.append(bar(t("engine.slots"), machine.promised_slots, machine.slots, of(machine.promised_slots, machine.slots)));
  item.append(
    bar(t("engine.cores"), machine.promised_cores, machine.cores, of(machine.promised_cores, machine.cores)),
    bar(t("engine.memory"), machine.promised_memory, machine.memory, of(megabytes(machine.promised_memory), megabytes(machine.memory))),
  );
  for (const advice of machine.advice) item.append(adviceLine(advice));
  return item;
}

function graphItems(graph) {
  return [
    element("li", graph.uri, "quiet"),
    ...graph.nodes.map((node) => {
      const counts = t("engine.graphNode", { publishes: node.publishes, subscribes: node.subscribes, serves: node.serves });
      return stateLine(node.name, t("engine.registered"), counts);
    }),
  ];
}

function engineItems(engine) {
  const containers = [...engine.containers].sort((a, b) => a.tag.localeCompare(b.tag, "en", { numeric: true }));
  return [
    ...containers.map(containerItem),
    connectionsItem(engine.connections),
    ...(engine.machines ?? []).map(machineItem),
  ];
}

// The connections: one element, so that its list stays open, and keeps its place, while the state is drawn again.
const shown = { item: null, summary: null, body: null };

function connectionsItem(connections) {
  if (!shown.item) {
    shown.item = element("li");
    shown.summary = element("summary");
    shown.body = element("tbody");
    const [details, table, box] = [element("details"), element("table"), element("div", "", "scroll")];
    details.id = "connections";
    details.addEventListener("toggle", () => drawConnections(shown.connections));
    table.append(shown.body);
    box.append(table);
    details.append(shown.summary, box);
    shown.item.append(details);
  }
  drawConnections(connections);
  return shown.item;
}

function drawConnections(connections) {
  shown.connections = connections;
  const up = connections.filter(({ established }) => established).length;
  const sum = (part) => connections.reduce((all, one) => all + (one[part] ?? 0), 0);
  shown.summary.textContent = t("engine.connections", { up, count: connections.length, rate: rate(sum("messages_s"), sum("bytes_s")) });
  if (!shown.summary.parentElement.open) return;
  const busiest = [...connections].sort((a, b) => (b.messages_s ?? 0) - (a.messages_s ?? 0) || (b.bytes_s ?? 0) - (a.bytes_s ?? 0));
  shown.body.replaceChildren(...busiest.slice(0, MOST_CONNECTIONS).map((one) => {
    const row = element("tr");
    const between = element("td", `${one.tag_a} \u2194 ${one.tag_b}`, one.established ? "" : "bad");
    const carries = one.established ? (one.messages_s === undefined ? "" : rate(one.messages_s, one.bytes_s, "engine.rate.short")) : t("engine.down");
    row.append(between, element("td", carries, "rate quiet"));
    return row;
  }));
}

// The list with the state of an engine or ROS graph, or the error that prevents reading it.
export function engineList(engine) {
  if (engine.error) return element("p", engine.error, "bad");
  const list = element("ul");
  list.append(...(engine.graph ? graphItems(engine.graph) : engineItems(engine)));
  return list;
}
