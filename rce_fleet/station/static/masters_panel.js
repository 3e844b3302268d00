// Which of several masters leads, in which term, how long the last change took; in a demo, a button kills it.

import { element } from "./engine.js";
import { ask } from "./requests.js";
import { t } from "./texts.js";

const TONE = { leader: "good", standby: "quiet" };
const ROLES = { leader: "masters.leads", standby: "masters.standby", away: "masters.away" };

export class MastersPanel {
  #kill = null;

  constructor(fleet, operator) {
    this.fleet = fleet;
    this.operator = operator;
    this.box = document.querySelector("#masters");
    fleet.addEventListener("masters", () => this.draw());
  }

  set steers(steers) {
    this.maySteer = steers;
    this.draw();
  }

  draw() {
    const { masters } = this.fleet;
    this.box.hidden = !masters;
    if (!masters) return;
    const leads = masters.masters.some(({ role }) => role === "leader");
    const summary = element("p", leads ? t("masters.term", { term: masters.term }) : t("masters.none"), leads ? "" : "bad");
    if (masters.change_s !== null) summary.append(element("span", ` ${t("masters.change", { seconds: masters.change_s.toFixed(1) })}`, "quiet"));
    const list = element("ul");
    list.append(...masters.masters.map(({ url, role }) => {
      const item = element("li");
      item.append(element("span", `${new URL(url).host} `), element("span", t(ROLES[role] ?? "masters.notReady"), TONE[role] ?? "bad"));
      return item;
    }));
    this.box.replaceChildren(summary, list, ...(masters.kills && this.maySteer ? [this.#button(leads)] : []));
  }

  // One element, so that it keeps the focus while the state is drawn again.
  #button(leads) {
    if (!this.#kill) {
      this.#kill = element("button", t("masters.kill"));
      this.#kill.type = "button";
      this.#kill.id = "kill-leader";
      this.#kill.addEventListener("click", () => this.operator.act(t("masters.kill"), () => ask("POST", "/masters/kill-leader")));
    }
    this.#kill.disabled = !leads;
    return this.#kill;
  }
}
