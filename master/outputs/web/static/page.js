// The page of the WebSocket output: connects by itself, again and again, and says how it goes.

import { HandView } from "./hand.js";

const AGAIN_MS = [500, 1000, 2000, 4000]; // waits before the next try
const PING_MS = 1000, SHOWN_MS = 500;
const THEMES = ["auto", "light", "dark"];
const TIPS = [4, 9, 14, 19, 24];
const byId = (id) => document.getElementById(id);

const view = new HandView(byId("hand"), { label: "3D view of the hands as they are tracked" });
globalThis.handView = view; // for the browser's own console

let poses = 0, refused = 0, tries = 0, roundTripMs = NaN, newest = null, heardMs = -Infinity;

function connect() {
  const secure = location.protocol === "https:" ? "wss" : "ws";
  const socket = new WebSocket(`${secure}://${location.host}/hands`);
  let pinging;
  const ping = () => {
    if (socket.readyState === WebSocket.OPEN) socket.send(`ping ${performance.now()}`);
  };
  socket.onopen = () => {
    tries = 0;
    pinging = setInterval(ping, PING_MS);
    ping();
  };
  socket.onmessage = ({ data }) => take(data);
  socket.onclose = () => {
    clearInterval(pinging);
    roundTripMs = NaN;
    setTimeout(connect, AGAIN_MS[Math.min(tries++, AGAIN_MS.length - 1)]);
    show();
  };
  connect.socket = socket;
}

function take(text) {
  const message = JSON.parse(text);
  if (message.type === "pong") {
    roundTripMs = performance.now() - Number(message.ping.slice("ping ".length));
    return;
  }
  try {
    view.push(message);
  } catch (error) {
    refused += 1;
    if (refused === 1) console.error("a message could not be shown", error);
    return;
  }
  if (message.type !== "hand") return;
  poses += 1;
  newest = message;
  heardMs = performance.now();
}

function say(id, text, state) {
  const element = byId(id);
  if (element.textContent !== text) element.textContent = text;
  if (state) element.dataset.state = state;
}

function inView() {
  const hands = [...view.hands.values()].filter(({ rig }) => rig.group.visible).length;
  return hands === 0 ? "the hand is not seen" : hands === 1 ? "one hand" : `${hands} hands`;
}

function show(seconds = SHOWN_MS / 1000) {
  const open = connect.socket?.readyState === WebSocket.OPEN;
  const hearing = open && performance.now() - heardMs < 2000;
  if (!open) say("link", "Not connected; trying again", "waiting");
  else if (!hearing) say("link", "Connected; no hand is sent now", "idle");
  else say("link", `Connected; ${inView()}`, "open");
  say("rate", hearing ? `${Math.round(poses / seconds)} /s` : "–");
  const latencyMs = hearing ? newest.latency_ms + (roundTripMs || 0) / 2 : NaN;
  say("latency", Number.isFinite(latencyMs) ? `${latencyMs.toFixed(1)} ms` : "–");
  const tips = hearing ? TIPS.map((j) => newest.joints[j].sigma_mm).filter((sigma) => sigma !== null) : [];
  say("sigma", tips.length ? `${Math.max(...tips).toFixed(1)} mm` : "–");
}

function buttons() {
  const turn = Math.PI / 12;
  const acts = {
    left: () => view.orbit(-turn, 0), right: () => view.orbit(turn, 0),
    up: () => view.orbit(0, turn), down: () => view.orbit(0, -turn),
    in: () => view.zoom(1.25), out: () => view.zoom(0.8), centre: () => view.resetCamera(),
  };
  for (const [id, act] of Object.entries(acts)) byId(id).addEventListener("click", act);
  byId("joints").addEventListener("click", ({ target }) => {
    const on = target.getAttribute("aria-pressed") !== "true";
    target.setAttribute("aria-pressed", String(on));
    view.setJoints(on);
  });
  byId("theme").addEventListener("click", () => use(THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length]));
}

let theme = localStorage.getItem("theme") ?? "auto";

function use(wanted) {
  theme = THEMES.includes(wanted) ? wanted : "auto";
  localStorage.setItem("theme", theme);
  document.documentElement.dataset.theme = theme;
  byId("theme").textContent = `Theme: ${theme}`;
  view.setTheme(theme);
}

let lastMs = performance.now();
setInterval(() => {
  const now = performance.now();
  show((now - lastMs) / 1000);
  poses = 0;
  lastMs = now;
}, SHOWN_MS);
buttons();
use(theme);
connect();
