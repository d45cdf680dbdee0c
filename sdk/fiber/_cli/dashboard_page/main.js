// The page: it takes the updates of the server, and draws them.

import { LineChart } from "./charts.js";
import { bytes, number, seconds } from "./format.js";
import { Model } from "./model.js";
import { fill, whenOpen } from "./tables.js";
import { Timeline } from "./timeline.js";

const AGAIN = 2000; // milliseconds until the next attempt to connect
const HIDDEN = 60000; // milliseconds after which a page that nobody sees asks for no more
const ROWS = 100;
const PROCESSES = 500;
const STATES = ["busy", "idle", "running", "starting", "waiting", "leaving"];

const find = (id) => document.getElementById(id);
const model = new Model();
const timeline = new Timeline(model);
const charts = {
  rate: new LineChart("rate", [
    { label: "done", colour: "#2ba58c", format: number },
    { label: "failed", colour: "#d9635b", format: number },
  ]),
  tasks: new LineChart("tasks", [
    { label: "waiting", colour: "#e08a2e", format: number },
    { label: "with workers", colour: "#3b82c4", format: number },
  ]),
  workers: new LineChart("workers", [
    { label: "there", colour: "#3b82c4", format: number },
    { label: "busy", colour: "#2ba58c", format: number },
    { label: "starting", colour: "#c9a227", format: number },
    { label: "waiting for a host", colour: "#c45ab3", format: number },
  ]),
  usage: new LineChart("usage", [
    { label: "memory", colour: "#7a6fd0", format: bytes },
    { label: "processors", colour: "#e08a2e", format: number, scale: "right" },
  ]),
};

// Connection

let feed = null;
let isLost = false;
let hiddenTimer = 0;

function connect() {
  feed = new WebSocket(`ws://${location.host}/feed`);
  feed.addEventListener("message", (event) => {
    isLost = false;
    model.apply(JSON.parse(event.data));
    schedule();
  });
  feed.addEventListener("close", () => {
    feed = null;
    if (model.status.state === "ended" || document.hidden) return;
    isLost = true;
    schedule();
    setTimeout(() => feed === null && connect(), AGAIN);
  });
}

document.addEventListener("visibilitychange", () => {
  clearTimeout(hiddenTimer);
  if (document.hidden) hiddenTimer = setTimeout(() => feed?.close(), HIDDEN);
  else if (feed === null && model.status.state !== "ended") connect();
  schedule();
});

// Drawing

let isScheduled = false;

function schedule() {
  if (isScheduled || document.hidden) return;
  isScheduled = true;
  requestAnimationFrame(() => {
    isScheduled = false;
    drawStatus();
    if (model.activity) draw();
  });
}

function draw() {
  drawAbout();
  drawFigures();
  drawCharts();
  timeline.update();
  drawLegend();
  drawTables();
}

function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function drawStatus() {
  const { state, text } = model.status;
  const shown = isLost ? "no connection" : { silent: "does not answer" }[state] || state;
  const badge = find("status");
  badge.dataset.state = isLost ? "silent" : state;
  setText(badge, shown);
  const notices = {
    ended: "The program has ended. The page shows the last state that it has reported.",
    silent: "The program does not answer. The page shows its last state, and asks again.",
  };
  const lost = "The dashboard does not answer: it has ended, or this machine is busy. The page tries again.";
  const notice = isLost ? lost : notices[state] ? `${notices[state]} ${text && `(${text})`}`.trim() : "";
  setText(find("notice"), notice);
  find("notice").hidden = !notice;
}

function drawAbout() {
  const program = model.program;
  const age = model.status.state === "running" ? Date.now() / 1000 - program.started : model.activity.now;
  setText(find("name"), program.name);
  setText(find("about"), [
    program.command, `backend ${program.backend}`, `runs for ${seconds(Math.max(0, age))}`,
    `Python ${program.python}`, `Fiber ${program.fiber}`,
  ].join(" · "));
  document.title = `${program.name} – ${number(model.activity.tasks)} tasks – Fiber`;
}

function drawFigures() {
  const activity = model.activity;
  const isRunning = model.status.state === "running";
  const figures = [
    ["tasks done", activity.tasks],
    ["failed", activity.failed, "bad"],
    ["retried", activity.retried],
    ["lost runs", activity.lost, "bad"],
    ["tasks a second", isRunning ? model.rate() : 0],
    ["waiting", model.sum("waiting")],
    ["with workers", model.sum("held")],
    ["processes", model.state.children.length],
    ["hosts", new Set(model.state.children.map((child) => child.host).filter(Boolean)).size],
  ].map(([name, value, kind]) => [name, number(value), value ? kind : ""]);
  figures.push(["sent", bytes(activity.bytes_sent), ""], ["received", bytes(activity.bytes_received), ""]);
  const place = find("figures");
  if (!place.children.length) {
    for (const [name] of figures) {
      const group = document.createElement("div");
      const term = document.createElement("dt");
      const value = document.createElement("dd");
      term.textContent = name;
      value.dataset.figure = name;
      group.append(term, value);
      place.append(group);
    }
  }
  place.querySelectorAll("dd").forEach((value, at) => {
    setText(value, figures[at][1]);
    value.className = figures[at][2] || "";
  });
}

function drawCharts() {
  const samples = model.samples;
  const times = samples.map((sample) => sample.at);
  const values = (key) => samples.map((sample) => sample[key]);
  const count = (...states) =>
    samples.map((sample) => states.reduce((sum, state) => sum + (sample.states[state] || 0), 0));
  charts.rate.draw(model.rates());
  charts.tasks.draw([times, values("waiting"), values("held")]);
  charts.workers.draw([
    times, count("busy", "idle", "running", "leaving"), count("busy"), count("starting"), count("waiting"),
  ]);
  const isKnown = samples.some((sample) => sample.memory !== null || sample.share !== null);
  find("usage").hidden = !isKnown;
  find("usage-unknown").hidden = isKnown;
  if (isKnown) charts.usage.draw([times, values("memory"), values("share")]);
}

function drawLegend() {
  const legend = find("legend");
  const names = model.activity.functions.slice(0, 12).map((each) => each.name);
  names.forEach((name, at) => {
    let entry = legend.children[at];
    if (!entry) {
      entry = document.createElement("li");
      const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
      svg.setAttribute("viewBox", "0 0 10 10");
      svg.setAttribute("aria-hidden", "true");
      svg.append(document.createElementNS("http://www.w3.org/2000/svg", "rect"));
      svg.firstChild.setAttribute("width", "10");
      svg.firstChild.setAttribute("height", "10");
      entry.append(svg, document.createElement("span"));
      legend.append(entry);
    }
    entry.querySelector("rect").setAttribute("fill", timeline.colour(name));
    setText(entry.lastChild, name);
  });
  while (legend.children.length > names.length) legend.lastChild.remove();
}

function drawTables() {
  drawHosts();
  const slowest = model.state.pools.flatMap((pool) => pool.slowest).sort((a, b) => b.seconds - a.seconds);
  fill(find("slowest"), [["for", "number"], ["task", "text"], ["worker", "text"], ["host", "text"]],
    slowest.slice(0, 10).map((task) => [seconds(task.seconds), task.task, task.worker, task.host]), "no task runs");
  const functions = [...model.activity.functions].sort((a, b) => b.work - a.work);
  fill(find("functions"),
    [["function", "text"], ["tasks", "number"], ["failed", "number"], ["work", "number"], ["mean", "number"], ["longest", "number"]],
    functions.slice(0, ROWS).map((each) => [
      each.name, number(each.tasks), number(each.failed), seconds(each.work),
      each.tasks ? seconds(each.work / each.tasks) : "–", seconds(each.longest),
    ]), "no task is done");
  fill(find("deaths"), [["ago", "number"], ["process", "text"], ["host", "text"], ["reason", "text"]],
    [...model.state.deaths].reverse().map((death) => [
      seconds(Math.max(0, model.activity.start + model.activity.now - death.time)), death.name, death.host, death.reason,
    ]), "no process has died");
  whenOpen(find("process-table"), drawProcesses);
}

function drawHosts() {
  const hosts = model.hosts();
  fill(find("hosts"),
    [["host", "text"], ...STATES.map((state) => [state, "number"]), ["memory", "number"], ["processors", "number"]],
    hosts.slice(0, ROWS).map((host) => [
      host.node && host.node !== host.name ? `${host.name} (${host.node})` : host.name,
      ...STATES.map((state) => (host.states[state] ? number(host.states[state]) : "")),
      bytes(host.memory), number(host.share),
    ]), "no process runs");
}

function drawProcesses() {
  if (!model.activity) return;
  const usage = new Map(model.state.children.map((child) => [`${child.name} ${child.pid}`, child]));
  fill(find("process-table"), [
    ["process", "text"], ["host", "text"], ["pid", "number"], ["state", "text"], ["tasks", "number"], ["failed", "number"],
    ["work", "number"], ["memory", "number"], ["processors", "number"], ["end", "text"],
  ], timeline.rows.slice(0, PROCESSES).map((child) => {
    const now = child.ended === null ? usage.get(`${child.name} ${child.pid}`) : undefined;
    return [
      child.name, child.host, child.pid === null ? "–" : String(child.pid), now ? now.state : "ended",
      number(child.tasks), number(child.failed), seconds(child.work), bytes(now?.memory), number(now?.share),
      child.reason,
    ];
  }), "no process has been started");
}

// Output of the program

let output = "";

async function showOutput() {
  let answer;
  try {
    answer = await (await fetch("/output")).json();
  } catch {
    answer = { problem: "The dashboard does not answer." };
  }
  setText(find("output-problem"), answer.problem || "");
  find("output-problem").hidden = !answer.problem;
  output = answer.text || "";
  filterOutput();
}

function filterOutput() {
  const wanted = find("output-filter").value;
  const lines = output.split("\n").filter((line) => line.includes(wanted));
  setText(find("output"), lines.join("\n"));
  find("output").hidden = !output;
  find("output").scrollTop = find("output").scrollHeight;
}

find("show-output").addEventListener("click", showOutput);
find("output-filter").addEventListener("input", filterOutput);
find("process-table").closest("details").addEventListener("toggle", drawProcesses);
setInterval(() => model.activity && !document.hidden && drawAbout(), 1000);
connect();
