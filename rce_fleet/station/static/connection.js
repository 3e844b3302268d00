// The WebSocket to the station: it comes back after a loss, and tells what it brought.

import { Fleet } from "./model.js";

const PATH = "/api/v1/live?changes=1&frames=1";
const LOGIN_ENDED = 1008;
const BAD_REQUEST = 400; // the answer to a request without a WebSocket, where one would be accepted
const LONGEST_MS = 8000;

export class Connection {
  traffic = { messages: 0, bytes: 0, spent_ms: 0 }; // for measurements
  isLive = false;
  #socket = null;

  // onLink: (whether it is live) => shows it; onRefusal: (text) => tells why the station refuses it
  constructor(fleet, layers, onLink, onRefusal) {
    this.fleet = fleet;
    this.layers = layers;
    this.onLink = onLink;
    this.onRefusal = onRefusal;
  }

  send(message) {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(message));
  }

  open(delay = 500) {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}${PATH}`);
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    let opened = false;
    socket.addEventListener("open", () => {
      opened = true;
      this.#setLive(true);
      this.layers.request();
    });
    socket.addEventListener("message", ({ data }) => {
      const started = performance.now();
      this.#take(data, socket);
      this.traffic.messages++;
      this.traffic.bytes += data.byteLength ?? data.length;
      this.traffic.spent_ms += performance.now() - started;
    });
    socket.addEventListener("close", ({ code }) => {
      if (code === LOGIN_ENDED) return location.replace("/login");
      this.#setLive(false);
      if (!opened) this.#askWhy();
      setTimeout(() => this.open(opened ? 500 : Math.min(2 * delay, LONGEST_MS)), delay * (0.5 + Math.random()));
    });
  }

  // A browser does not tell why a WebSocket was refused.
  async #askWhy() {
    try {
      const response = await fetch(PATH);
      if (response.status <= BAD_REQUEST) return;
      const { error } = await response.json();
      if (!this.isLive) this.onRefusal(error);
    } catch {
      return; // the station is away, or its answer was cut off
    }
  }

  #setLive(live) {
    this.isLive = live;
    this.onLink(live);
  }

  #take(data, socket) {
    const { fleet, layers } = this;
    if (data instanceof ArrayBuffer) return Fleet.isFrame(data) ? fleet.applyFrame(data) : layers.takeFrame(data);
    const received = JSON.parse(data);
    if (received.type === "layer") return layers.take(received);
    fleet.apply(received);
    // A change is missing; the next connection begins with the complete state.
    if (received.type === "changes" && fleet.isBehind) socket.close();
  }
}
