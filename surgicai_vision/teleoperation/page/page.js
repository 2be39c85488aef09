// What is held and pressed goes out, images and status come in. Codes are KeyboardEvent.code.
"use strict";

const HEARTBEAT = 100; // ms between messages while something is held: the server lets go after 500 ms of silence
const buttons = [...document.querySelectorAll("button[data-code]")];
const codes = new Set(["ShiftRight", "KeyX", "KeyZ", "Enter", ...buttons.map((button) => button.dataset.code)]);
const client = Array.from(crypto.getRandomValues(new Uint8Array(12)), (byte) => byte.toString(16)).join("");
const held = new Set();
let pressed = [];
let number = 0;
let sending = false;
let lastSent = "";
let lastTime = 0;
let stopped = false;

// -- inputs -----------------------------------------------------------------------------------------------------------

function press(code) {
  if (held.has(code)) return;
  held.add(code);
  pressed.push(code);
  highlight();
  send();
}

function release(code) {
  if (held.delete(code)) { highlight(); send(); }
}

function releaseAll() {
  held.clear();
  highlight();
  send();
}

function highlight() {
  for (const button of buttons) button.classList.toggle("down", held.has(button.dataset.code));
}

function gamepads() {
  const axes = [0, 0, 0, 0], down = new Array(16).fill(0);
  let name = "";
  for (const pad of navigator.getGamepads ? navigator.getGamepads() : []) {
    if (!pad || pad.mapping !== "standard") continue;
    name = pad.id;
    for (let i = 0; i < 4; i++) axes[i] = Math.max(-1, Math.min(1, axes[i] + (pad.axes[i] || 0)));
    for (let i = 0; i < 16; i++) down[i] = Math.max(down[i], pad.buttons[i] ? pad.buttons[i].value : 0);
  }
  const round = (value) => Math.round(value * 1000) / 1000;
  return { axes: axes.map(round), buttons: down.map(round), name };
}

async function send() {
  if (sending || stopped) return;
  const pads = gamepads();
  const state = JSON.stringify([[...held], pads.axes, pads.buttons]);
  const active = held.size || pads.axes.some((value) => Math.abs(value) > 0.1) || pads.buttons.some((value) => value > 0);
  const due = active && performance.now() - lastTime > HEARTBEAT;
  if (!pressed.length && state === lastSent && !due) return;
  sending = true;
  const message = { client, number: number++, held: [...held], pressed, axes: pads.axes, buttons: pads.buttons };
  pressed = [];
  lastSent = state;
  for (;;) {
    try {
      // Sent again under the same number: the server takes each number once.
      const answer = await fetch("input", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(message) });
      if (answer.status < 500) break;
    } catch (error) {
      if (stopped) break;
    }
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
  lastTime = performance.now();
  sending = false;
  send();
}

addEventListener("keydown", (event) => {
  if (!codes.has(event.code) || event.ctrlKey || event.altKey || event.metaKey) return;
  event.preventDefault();
  if (!event.repeat) press(event.code);
});
addEventListener("keyup", (event) => { if (codes.has(event.code)) { event.preventDefault(); release(event.code); } });
addEventListener("blur", releaseAll);
document.addEventListener("visibilitychange", () => { if (document.hidden) releaseAll(); });
for (const button of buttons) {
  const code = button.dataset.code;
  const latch = "latch" in button.dataset; // a finger cannot hold Shift and another button
  button.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    if (latch && held.has(code)) release(code); else press(code);
    if (!latch) button.setPointerCapture(event.pointerId);
  });
  for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) button.addEventListener(end, () => { if (!latch) release(code); });
  button.addEventListener("contextmenu", (event) => event.preventDefault());
}
for (const figure of document.querySelectorAll("figure")) {
  figure.addEventListener("click", () => {
    if (figure.parentElement.id === "others") { press("KeyV"); release("KeyV"); }
  });
}
setInterval(() => { element("gamepad").textContent = gamepads().name ? `Found: ${gamepads().name}` : ""; }, 1000);
setInterval(send, 20);

// -- status and images ---------------------------------------------------------------------------------------------------

function showStatus(status) {
  const text = {
    episode: status.episode, seed: status.seed, subtask: `${status.subtask}, ${status.arm}`,
    time: `${(status.steps / 50).toFixed(1)} of ${status.limit / 50} s`, distance: `${(status.distance * 1000).toFixed(1)} mm`,
    angle: `${(status.angle * 180 / Math.PI).toFixed(0)}°`, contact: status.contact ? "yes" : "no",
    counts: `${status.kept} / ${status.discarded}`, text: status.message,
    state: status.fine ? `${status.state}, fine` : status.state,
  };
  for (const [id, value] of Object.entries(text)) setText(id, value);
  element("message").className = status.state === "judged" ? (status.success ? "good" : "bad") : status.state;
  document.body.className = status.state;
  const [before, lead] = [document.querySelector("#lead figure"), document.querySelector(`figure[data-view="${status.view}"]`)];
  if (before !== lead) {
    element("others").append(before);
    element("lead").append(lead);
  }
  stopped = status.state === "stopped";
}

function showLost() {
  element("message").className = "lost";
  setText("state", "no connection");
  setText("text", "The session has ended, or the network is down.");
}

follow(showStatus, showLost);
