// The timeline: one row a process, on one canvas, however many tasks there were.

import { mark, number, seconds } from "./format.js";

const ROW = 16;
const BAR = 11;
const AXIS = 22;
const PALETTE = [
  "#3b82c4", "#e08a2e", "#2ba58c", "#c45ab3", "#8a9a2b", "#7a6fd0",
  "#d9635b", "#3fa9c9", "#a67c52", "#5f9e4a", "#c9a227", "#9b5f8f",
];
const OTHER = "#8d979e";
const BEGIN = 0, END = 1, FUNCTION = 2, WORK = 3, TASKS = 4, FAILED = 5;

export class Timeline {
  constructor(model) {
    this.model = model;
    this.place = document.getElementById("timeline");
    this.spacer = this.place.querySelector(".spacer");
    this.canvas = this.place.querySelector("canvas");
    this.tip = document.getElementById("tip");
    this.living = document.getElementById("living");
    this.view = null; // [from, to] in seconds, or null for the whole run
    this.follows = true; // the view moves with the time
    this.rows = [];
    this.colours = new Map();
    this.pointers = new Map();
    this.isDirty = false;
    this.listen();
  }

  listen() {
    this.place.addEventListener("scroll", () => this.redraw());
    this.place.addEventListener("keydown", (event) => this.pressed(event));
    this.place.addEventListener("wheel", (event) => this.wheeled(event), { passive: false });
    this.place.addEventListener("pointerdown", (event) => this.pointers.set(event.pointerId, event.clientX));
    this.place.addEventListener("pointermove", (event) => this.moved(event));
    for (const name of ["pointerup", "pointercancel", "pointerleave"]) {
      this.place.addEventListener(name, (event) => {
        this.pointers.delete(event.pointerId);
        this.tip.hidden = true;
      });
    }
    for (const button of document.querySelectorAll("[data-act]")) {
      button.addEventListener("click", () => this.act(button.dataset.act));
    }
    this.living.addEventListener("change", () => this.update());
    new ResizeObserver(() => this.redraw()).observe(this.place);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw());
  }

  // Ways to move the view

  act(what) {
    const [from, to] = this.range();
    const length = to - from;
    if (what === "all") this.view = null;
    else if (what === "in") this.zoom(1 / 1.6, this.follows ? to : (from + to) / 2);
    else if (what === "out") this.zoom(1.6, this.follows ? to : (from + to) / 2);
    else if (what === "earlier") this.show(from - length / 4, to - length / 4);
    else if (what === "later") this.show(from + length / 4, to + length / 4);
    this.redraw();
  }

  pressed(event) {
    const keys = { ArrowLeft: "earlier", ArrowRight: "later", "+": "in", "=": "in", "-": "out", 0: "all" };
    const what = keys[event.key];
    if (!what || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    this.act(what);
  }

  wheeled(event) {
    if (event.ctrlKey || event.metaKey) this.zoom(Math.exp(event.deltaY / 300), this.timeAt(event.clientX));
    else if (event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)) this.pan(event.deltaX || event.deltaY);
    else return; // the rows scroll
    event.preventDefault();
    this.redraw();
  }

  moved(event) {
    const before = this.pointers.get(event.pointerId);
    if (before === undefined) {
      this.showTip(event);
      return;
    }
    if (this.pointers.size === 2) {
      const [other] = [...this.pointers].filter(([id]) => id !== event.pointerId);
      const apart = Math.abs(before - other[1]), now = Math.abs(event.clientX - other[1]);
      if (apart > 5 && now > 5) this.zoom(apart / now, this.timeAt((event.clientX + other[1]) / 2));
    } else {
      this.pan(before - event.clientX);
    }
    this.pointers.set(event.pointerId, event.clientX);
    this.redraw();
  }

  pan(pixels) {
    const [from, to] = this.range();
    const by = (pixels / this.plotWidth()) * (to - from);
    this.show(from + by, to + by);
  }

  zoom(factor, around) {
    const [from, to] = this.range();
    const now = this.now();
    const length = Math.min(Math.max((to - from) * factor, 1e-3), now);
    if (length >= now) {
      this.view = null;
      return;
    }
    const begin = around - ((around - from) / (to - from)) * length;
    this.show(begin, begin + length);
  }

  show(from, to) {
    const length = to - from;
    const now = this.now();
    const end = Math.min(Math.max(to, length), now);
    this.view = [end - length, end];
    this.follows = end >= now;
  }

  now() {
    return Math.max(this.model.activity ? this.model.activity.now : 0, 1e-3);
  }

  range() {
    const now = this.now();
    if (!this.view) return [0, now];
    const [from, to] = this.view;
    return this.follows ? [now - (to - from), now] : [from, to];
  }

  // Geometry

  gutter() {
    return this.place.clientWidth < 500 ? 70 : 130;
  }

  plotWidth() {
    return Math.max(50, this.place.clientWidth - this.gutter());
  }

  timeAt(clientX) {
    const [from, to] = this.range();
    const x = clientX - this.place.getBoundingClientRect().left - this.gutter();
    return from + (x / this.plotWidth()) * (to - from);
  }

  // Contents

  update() {
    const all = [...this.model.children.values()];
    this.rows = this.living.checked ? all.filter((child) => child.ended === null) : all;
    this.rows.sort((a, b) => (a.pool ?? 0) - (b.pool ?? 0) || a.id - b.id);
    this.model.activity.functions.forEach(({ name }, at) => {
      this.colours.set(name, name.startsWith("(") ? OTHER : PALETTE[at % PALETTE.length]);
    });
    this.redraw();
  }

  colour(name) {
    return this.colours.get(name) || OTHER;
  }

  redraw() {
    if (this.isDirty) return;
    this.isDirty = true;
    requestAnimationFrame(() => {
      this.isDirty = false;
      if (this.model.activity) this.draw();
    });
  }

  draw() {
    this.place.style.height = `${AXIS + Math.max(this.rows.length, 4) * ROW + 8}px`; // CSS has the largest
    const width = this.place.clientWidth, height = this.place.clientHeight;
    this.spacer.style.height = `${Math.max(height, AXIS + this.rows.length * ROW)}px`;
    const ratio = devicePixelRatio || 1;
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
      this.canvas.style.height = `${height}px`;
    }
    const pen = this.canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const style = getComputedStyle(document.documentElement);
    this.ink = {
      text: style.getPropertyValue("--text"), faint: style.getPropertyValue("--faint"),
      line: style.getPropertyValue("--line"), bad: style.getPropertyValue("--bad"),
      panel: style.getPropertyValue("--panel"),
    };
    pen.font = "12px system-ui, sans-serif";
    pen.textBaseline = "middle";
    const top = this.place.scrollTop;
    const first = Math.max(0, Math.floor((top - AXIS) / ROW));
    const last = Math.min(this.rows.length, Math.ceil((top + height - AXIS) / ROW) + 1);
    for (let at = first; at < last; at += 1) this.drawRow(pen, this.rows[at], AXIS + at * ROW - top);
    this.drawAxis(pen, width, height);
  }

  drawRow(pen, child, y) {
    const [from, to] = this.range();
    const left = this.gutter(), wide = this.plotWidth();
    const place = (time) => left + ((time - from) / (to - from)) * wide;
    const clip = (x) => Math.min(Math.max(x, left), left + wide);
    const middle = y + ROW / 2, top = y + (ROW - BAR) / 2;
    const end = child.ended ?? this.now();
    const began = clip(place(child.began)), started = clip(place(child.started ?? end));
    pen.fillStyle = this.ink.line;
    pen.fillRect(began, middle - 0.5, started - began, 1); // asked for, and not there yet
    pen.fillRect(started, middle - 1.5, clip(place(end)) - started, 3); // there
    const spans = child.spans;
    for (let at = firstEndingAfter(spans, from); at < spans.length && spans[at][BEGIN] <= to; at += 1) {
      const span = spans[at];
      const x = clip(place(span[BEGIN]));
      pen.fillStyle = this.colour(span[FUNCTION]);
      pen.fillRect(x, top, Math.max(clip(place(span[END])) - x, 0.7), BAR);
      if (span[FAILED]) {
        pen.fillStyle = this.ink.bad;
        const share = Math.min(1, span[FAILED] / Math.max(span[TASKS], 1));
        pen.fillRect(x, top + BAR - 3, Math.max((clip(place(span[END])) - x) * share, 1.5), 3);
      }
    }
    if (child.reason && child.ended >= from && child.ended <= to) this.drawDeath(pen, place(child.ended), middle);
    pen.fillStyle = child.reason ? this.ink.bad : child.ended === null ? this.ink.text : this.ink.faint;
    pen.fillText(shortened(pen, child.name, left - 14), 6, middle);
  }

  drawDeath(pen, x, y) {
    pen.strokeStyle = this.ink.bad;
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(x - 4, y - 4);
    pen.lineTo(x + 4, y + 4);
    pen.moveTo(x + 4, y - 4);
    pen.lineTo(x - 4, y + 4);
    pen.stroke();
  }

  drawAxis(pen, width, height) {
    const [from, to] = this.range();
    const left = this.gutter(), wide = this.plotWidth();
    pen.fillStyle = this.ink.panel;
    pen.fillRect(0, 0, width, AXIS - 2);
    const step = niceStep((to - from) / Math.max(2, wide / 90));
    for (let time = Math.ceil(from / step) * step; time <= to; time += step) {
      const x = left + ((time - from) / (to - from)) * wide;
      pen.fillStyle = this.ink.line;
      pen.fillRect(x, AXIS - 6, 1, 4);
      pen.fillStyle = this.ink.faint;
      const text = mark(time, step);
      pen.fillText(text, Math.min(x + 2, width - pen.measureText(text).width - 2), 9);
    }
    pen.fillStyle = this.ink.line;
    pen.fillRect(left - 1, 0, 1, height);
  }

  // The process and the work under the pointer

  showTip(event) {
    const y = event.clientY - this.place.getBoundingClientRect().top + this.place.scrollTop - AXIS;
    const child = this.rows[Math.floor(y / ROW)];
    if (y < 0 || !child) {
      this.tip.hidden = true;
      return;
    }
    this.tip.textContent = this.described(child, this.timeAt(event.clientX)).join("\n");
    this.tip.hidden = false;
    const x = Math.min(event.clientX + 14, innerWidth - this.tip.offsetWidth - 8);
    this.tip.style.transform = `translate(${x}px, ${Math.min(event.clientY + 14, innerHeight - this.tip.offsetHeight - 8)}px)`;
  }

  described(child, time) {
    const lines = [`${child.name} on ${child.host || "no host yet"}`];
    const span = child.spans[firstEndingAfter(child.spans, time)];
    if (span && span[BEGIN] <= time) {
      lines.push(`${span[FUNCTION]}: ${number(span[TASKS])} tasks, ${seconds(span[WORK])} of work`);
      if (span[FAILED]) lines.push(`${number(span[FAILED])} failed`);
    }
    lines.push(`${number(child.tasks)} tasks in all`);
    if (child.reason) lines.push(child.reason);
    return lines;
  }
}

// Index of the first span that ends after a time.  The spans of a process follow each other.
function firstEndingAfter(spans, time) {
  let low = 0, high = spans.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (spans[middle][END] < time) low = middle + 1;
    else high = middle;
  }
  return low;
}

function niceStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  const found = [1, 2, 5, 10].find((each) => each * power >= least) * power;
  return found > 60 ? [60, 120, 300, 600, 1800, 3600, 7200, 21600, 86400].find((each) => each >= least) || found : found;
}

function shortened(pen, text, width) {
  if (pen.measureText(text).width <= width) return text;
  let length = text.length;
  while (length > 1 && pen.measureText(`…${text.slice(-length)}`).width > width) length -= 1;
  return `…${text.slice(-length)}`;
}
