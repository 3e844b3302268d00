// A question about what cannot be taken back, asked in the page. Keys: Tab and Enter choose, Esc means no.

import { t } from "./texts.js";

const dialog = document.querySelector("#question");

// Ask the question of this name; return whether the operator said yes. Meanwhile others are answered by no.
export async function isCertain(name, values = {}) {
  if (dialog.open) return false;
  document.querySelector("#question-text").textContent = t(`question.${name}`, values);
  dialog.returnValue = "";
  const closed = new Promise((resolve) => { dialog.addEventListener("close", resolve, { once: true }); });
  dialog.showModal();
  await closed;
  return dialog.returnValue === "yes";
}
