// Who did what at this station: the newest first, found by user, action or robot.

import { element } from "./engine.js";
import { t } from "./texts.js";

const MOST_KEPT = 1000;
const PAGE = 100; // lines that are shown at first, and with each click on "more"

export class AuditPanel {
  #entries = [];     // the newest first
  #keys = new Set(); // of the entries: a station sends the last ones again when the page connects again
  #shown = PAGE;
  #drawing = null;

  constructor(fleet) {
    this.list = document.querySelector("#audit");
    this.find = document.querySelector("#audit-find");
    this.more = document.querySelector("#audit-more");
    this.csv = document.querySelector("#audit-csv");
    fleet.addEventListener("audit", ({ detail }) => this.add(detail));
    fleet.addEventListener("manager", () => { this.csv.hidden = !fleet.manager; });
    this.find.addEventListener("input", () => {
      this.#shown = PAGE;
      this.draw();
    });
    this.more.addEventListener("click", () => {
      this.#shown += PAGE;
      this.draw();
    });
  }

  // What an operator or a program did; other operators see it too.
  add(entry) {
    const key = JSON.stringify(entry);
    if (this.#keys.has(key)) return;
    this.#keys.add(key);
    this.#entries.unshift({ ...entry, key });
    while (this.#entries.length > MOST_KEPT) this.#keys.delete(this.#entries.pop().key);
    document.querySelector("#audit-section").hidden = false;
    this.#drawing ??= requestAnimationFrame(() => this.draw());
  }

  draw() {
    this.#drawing = null;
    const wanted = this.find.value.trim().toLowerCase();
    const found = this.#entries.filter((entry) => !wanted || `${entry.user} ${whatOf(entry)}`.toLowerCase().includes(wanted));
    this.list.replaceChildren(...found.slice(0, this.#shown).map(line));
    this.more.hidden = found.length <= this.#shown;
  }
}

function whatOf({ name, subject, detail }) {
  return `${name.replaceAll("_", " ")} ${subject}${detail ? `: ${detail}` : ""}`;
}

function line(entry) {
  const item = element("li");
  const at = new Date(1000 * entry.time);
  const isToday = at.toDateString() === new Date().toDateString();
  const time = element("time", isToday ? at.toLocaleTimeString() : t("audit.dated", { date: at.toLocaleDateString(), time: at.toLocaleTimeString() }));
  time.dateTime = at.toISOString();
  item.append(time, element("b", `${entry.user} `), element("span", whatOf(entry), entry.done ? "" : "bad"));
  return item;
}
