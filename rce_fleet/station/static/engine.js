// The engine's state: containers with usage, nodes and advice; or the nodes of a ROS graph.

const TONE = {
  running: "good", connected: "good", placed: "warn", starting: "warn", requested: "warn", waiting: "warn",
  absent: "warn", draining: "warn", away: "bad", degraded: "warn", stopped: "warn", stopping: "warn", failed: "bad", lost: "bad", stuck: "bad",
};
const NEARLY_FULL = 0.9;

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

const megabytes = (count) => `${Math.round(count / 2 ** 20)} MB`;
const percent = (cores) => `${Math.round(100 * cores)} %`;

function uses(usage) {
  const found = document.createDocumentFragment();
  const cpu = usage.cpu_limit ? `${percent(usage.cpu)} of ${percent(usage.cpu_limit)}` : percent(usage.cpu);
  const memory = usage.memory_limit ? `${megabytes(usage.memory)} of ${megabytes(usage.memory_limit)}` : megabytes(usage.memory);
  found.append(bar("CPU", usage.cpu, usage.cpu_limit, cpu), bar("Memory", usage.memory, usage.memory_limit, memory));
  const troubles = [];
  if (usage.restarts) troubles.push(usage.restarts === 1 ? "1 restart" : `${usage.restarts} restarts`);
  if (usage.oom_kills) troubles.push(usage.oom_kills === 1 ? "once out of memory" : `${usage.oom_kills} times out of memory`);
  if (troubles.length) found.append(element("div", troubles.join(", "), "use warn"));
  return found;
}

function adviceLine(advice) {
  const line = element("p", "", "advice");
  line.append(element("span", `${advice.about}: `, "warn"), element("span", `${advice.text} `), element("code", advice.command));
  return line;
}

function containerItem(container) {
  const place = container.moving_to ? `${container.machine}, moving to ${container.moving_to}` : container.machine;
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
  const item = stateLine(machine.machine, state, `${machine.containers} containers`);
  if (machine.slots) item.append(bar("Slots", machine.promised_slots, machine.slots, `${machine.promised_slots} of ${machine.slots}`));
  item.append(
    bar("Cores", machine.promised_cores, machine.cores, `${machine.promised_cores} of ${machine.cores}`),
    bar("Memory", machine.promised_memory, machine.memory, `${megabytes(machine.promised_memory)} of ${megabytes(machine.memory)}`),
  );
  for (const advice of machine.advice) item.append(adviceLine(advice));
  return item;
}

function graphItems(graph) {
  return [
    element("li", graph.uri, "quiet"),
    ...graph.nodes.map((node) => {
      const counts = `${node.publishes} out, ${node.subscribes} in, ${node.serves} services`;
      return stateLine(node.name, "registered", counts);
    }),
  ];
}

function engineItems(engine) {
  const containers = [...engine.containers].sort((a, b) => a.tag.localeCompare(b.tag, "en", { numeric: true }));
  const up = engine.connections.filter((connection) => connection.established).length;
  return [
    ...containers.map(containerItem),
    stateLine("connections", `${up} of ${engine.connections.length}`, "established"),
    ...(engine.machines ?? []).map(machineItem),
  ];
}

// The list with the state of an engine or ROS graph, or the error that prevents reading it.
export function engineList(engine) {
  if (engine.error) return element("p", engine.error, "bad");
  const list = element("ul");
  list.append(...(engine.graph ? graphItems(engine.graph) : engineItems(engine)));
  return list;
}
