// Logs a user of the engine in at the station; the token stays in a cookie that no script can read.

import { fillTexts, t } from "./texts.js";

fillTexts();
document.title = t("login.title");
const form = document.querySelector("#login");
const message = document.querySelector("#message");

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  message.textContent = "";
  const password = form.elements.password;
  try {
    const response = await fetch("/api/v1/login", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ userID: form.elements.user.value, password: password.value }),
    });
    if (response.ok) return location.replace("/");
    message.textContent = (await response.json()).error;
  } catch (error) {
    message.textContent = error.message;
  }
  message.className = "bad";
  password.value = "";
  password.focus();
});
