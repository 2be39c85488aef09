// Commands go out; images, status and the points of the curves come in.
"use strict";

const PER_DEGREE = 3; // pixels of a drag for a degree
const HEADROOM = 1.3; // of the curves, whose label stands above them
const buttons = [...document.querySelectorAll("button[data-command]")];
const choices = [...document.querySelectorAll("button[data-view-choice]")];
const curves = { episode: -1, next: 0, points: [] };
let status = null;

async function send(command, numbers = [], views = []) {
  try {
    await fetch("input", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify({ command, numbers, views }) });
  } catch (error) { /* follow() says so */ }
}

// -- the player -------------------------------------------------------------------------------------------------------

function act(command, number) {
  if (!buttons.length || !status) return;
  if (command === "play" && status.state === "playing") send("pause");
  else if (command === "speed") send("speed", [number]);
  else send(command);
}

function changeSpeed(by) {
  const speeds = buttons.filter((button) => button.dataset.command === "speed").map((button) => Number(button.dataset.number));
  const next = speeds[speeds.indexOf(status.speed) + by];
  if (next) act("speed", next);
}

for (const button of buttons) {
  button.addEventListener("click", () => { act(button.dataset.command, Number(button.dataset.number)); button.blur(); });
}
if (element("go-on")) element("go-on").addEventListener("change", (event) => send("go_on", [event.target.checked ? 1 : 0]));
const keys = {
  Space: () => act("play"), ArrowRight: () => act("step"), KeyN: () => act("next"), KeyR: () => act("again"), Escape: () => act("stop"),
  Minus: () => changeSpeed(-1), NumpadSubtract: () => changeSpeed(-1), Equal: () => changeSpeed(1), NumpadAdd: () => changeSpeed(1), BracketRight: () => changeSpeed(1),
};
addEventListener("keydown", (event) => {
  if (!buttons.length || !keys[event.code] || event.ctrlKey || event.altKey || event.metaKey) return;
  event.preventDefault();
  if (!event.repeat || event.code === "ArrowRight") keys[event.code]();
});

// -- views ------------------------------------------------------------------------------------------------------------

for (const button of choices) {
  const view = button.dataset.viewChoice;
  button.addEventListener("click", () => {
    if (!status) return;
    const others = status.views.filter((name) => name !== view);
    if (others.length === status.views.length) send("views", [], [...status.views, view].slice(-6));
    else if (others.length) send("views", [], others);
  });
}

function makeFigure(view) {
  const figure = document.createElement("figure");
  figure.dataset.view = view;
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 16;
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", `what the camera ${view} sees`);
  const caption = document.createElement("figcaption");
  caption.textContent = view;
  figure.append(canvas, caption);
  figure.addEventListener("click", () => {
    if (figure.parentElement.id === "others" && !figure.dragged) send("views", [], [view, ...status.views.filter((name) => name !== view)]);
  });
  if (view === "free") makeTurnable(figure, canvas);
  return figure;
}

function makeTurnable(figure, canvas) {
  const fingers = new Map();
  const drag = { command: "", right: 0, down: 0 };
  const spread = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
  // A drag is sent in pieces, one at a time.
  const flush = async () => {
    if (drag.sending || !drag.command) return;
    drag.sending = true;
    while (drag.right || drag.down) {
      const numbers = [drag.right, drag.down];
      drag.right = drag.down = 0;
      await send(drag.command, numbers);
    }
    drag.sending = false;
  };
  canvas.addEventListener("pointerdown", (event) => {
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    canvas.setPointerCapture(event.pointerId);
    figure.dragged = false;
  });
  canvas.addEventListener("pointermove", (event) => {
    const finger = fingers.get(event.pointerId);
    if (!finger) return;
    const before = fingers.size === 2 ? spread() : 0;
    const right = event.clientX - finger.x, down = event.clientY - finger.y;
    if (Math.abs(right) + Math.abs(down) < 1) return;
    finger.x = event.clientX;
    finger.y = event.clientY;
    figure.dragged = true;
    if (before) {
      const factor = before / Math.max(1, spread());
      if (factor > 0.1 && factor < 10) send("zoom", [factor]);
      return;
    }
    const shifts = event.shiftKey || event.buttons === 2;
    const command = shifts ? "shift" : "turn";
    if (command !== drag.command) { drag.command = command; drag.right = drag.down = 0; }
    const scale = shifts ? 1 / canvas.clientHeight : 1 / PER_DEGREE;
    drag.right += right * scale;
    drag.down += down * scale;
    flush();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", () => send("home"));
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); send("zoom", [event.deltaY > 0 ? 1.12 : 1 / 1.12]); }, { passive: false });
}

function arrange(views) {
  const figures = new Map([...document.querySelectorAll("figure")].map((figure) => [figure.dataset.view, figure]));
  const shown = [...figures.keys()];
  const wanted = [...element("lead").children, ...element("others").children].map((figure) => figure.dataset.view);
  if (views.length === wanted.length && views.every((view, place) => view === wanted[place])) return;
  for (const view of shown) if (!views.includes(view)) figures.get(view).remove();
  views.forEach((view, place) => element(place ? "others" : "lead").append(figures.get(view) || makeFigure(view)));
  for (const button of choices) {
    const isShown = views.includes(button.dataset.viewChoice);
    button.classList.toggle("down", isShown);
    button.setAttribute("aria-pressed", isShown);
  }
}

// What is asked for, and what this machine reaches where that is less.
function pace() {
  const asked = status.speed === 1 ? status.state : `${status.state}, ${status.speed}×`;
  return status.reached && status.reached < 0.85 * status.speed ? `${asked} (here ${status.reached.toPrecision(1)}×)` : asked;
}

// -- status and curves ------------------------------------------------------------------------------------------------

function showStatus(next) {
  status = next;
  const now = status.moment;
  const text = {
    episode: status.episode, seed: status.seed < 0 ? "–" : status.seed, time: `${(now.step / 50).toFixed(2)} s`, step: `${now.step} of ${status.limit}`,
    subtask: now.subtask, angle: `${(now.angle * 180 / Math.PI).toFixed(0)}°`, contact: now.contact ? "yes" : "no",
    counts: status.episodes ? `${status.successes} of ${status.episodes}` : "–", distance: `${(now.distance * 1000).toFixed(1)} mm`,
    force: `${now.force.toFixed(2)} N`, state: pace(), text: status.message,
  };
  for (const [id, value] of Object.entries(text)) setText(id, value);
  element("message").className = status.state === "ended" ? (now.success ? "good" : "bad") : status.state;
  document.body.className = status.state;
  if (buttons.length) {
    setText("play-text", status.state === "playing" ? "pause" : "play");
    element("go-on").checked = status.go_on;
    for (const button of buttons) if (button.dataset.command === "speed") button.classList.toggle("down", Number(button.dataset.number) === status.speed);
  }
  element("stages").hidden = !status.is_procedure;
  [...element("stages").children].forEach((item, place) => {
    item.className = place < now.stages ? "done" : item.textContent === now.subtask ? "on" : "";
  });
  arrange(status.views);
  if (status.points !== curves.next || status.episode !== curves.episode) return fetchCurves();
  return undefined;
}

async function fetchCurves() {
  const answer = await (await fetch(`curves?after=${curves.next}`)).json();
  if (answer.episode !== curves.episode) {
    curves.episode = answer.episode;
    curves.points = [];
  }
  curves.points.push(...answer.points);
  curves.next = answer.next;
  drawCurves();
}

function drawCurves() {
  drawCurve("distance-curve", 0, "--distance", 5);
  drawCurve("force-curve", 1, "--force", 0.5);
}

addEventListener("resize", drawCurves);

function drawCurve(id, column, colour, least) {
  const canvas = element(id);
  const [width, height] = [Math.round(canvas.clientWidth * devicePixelRatio), Math.round(canvas.clientHeight * devicePixelRatio)];
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const pen = canvas.getContext("2d");
  const values = curves.points.map((point) => point[column]);
  const top = Math.max(least, ...values) * HEADROOM;
  const length = Math.max(100, values.length - 1);
  const style = getComputedStyle(document.documentElement);
  const edge = 3 * devicePixelRatio;
  pen.clearRect(0, 0, width, height);
  pen.font = `${10 * devicePixelRatio}px system-ui, sans-serif`;
  pen.fillStyle = style.getPropertyValue("--soft");
  pen.fillText(`${(top / HEADROOM).toPrecision(2)} ${column ? "N" : "mm"}`, edge, 11 * devicePixelRatio);
  pen.strokeStyle = pen.fillStyle = style.getPropertyValue(colour);
  pen.lineWidth = 1.5 * devicePixelRatio;
  pen.beginPath();
  let x = 0, y = 0;
  values.forEach((value, place) => {
    x = edge + (width - 2 * edge) * place / length;
    y = height - edge - (height - 2 * edge) * value / top;
    if (place) pen.lineTo(x, y); else pen.moveTo(x, y);
  });
  pen.stroke();
  if (values.length) { pen.beginPath(); pen.arc(x, y, edge, 0, 2 * Math.PI); pen.fill(); }
}

function showLost() {
  element("message").className = "lost";
  setText("state", "no connection");
  setText("text", "The session has ended, or the network is down.");
}

follow(showStatus, showLost);
