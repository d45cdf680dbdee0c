// Lines over the time of the run, drawn by uPlot, each with a table of its last figures.

import { mark } from "./format.js";
import { fill, whenOpen } from "./tables.js";

const HEIGHT = 190;
const ROWS = 40;

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

// `series`: a list of {label, colour, format, scale}; `scale` is "y" or "right".
export class LineChart {
  constructor(name, series) {
    this.place = document.getElementById(name);
    this.table = document.getElementById(`${name}-table`);
    this.series = series;
    this.data = [[], ...series.map(() => [])];
    this.table.closest("details").addEventListener("toggle", () => this.fillTable());
    new ResizeObserver(() => this.resize()).observe(this.place);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.rebuild());
    this.rebuild();
  }

  rebuild() {
    if (this.plot) this.plot.destroy();
    const text = colour("--faint"), grid = colour("--line");
    const line = { stroke: text, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid } };
    const formats = {};
    for (const each of this.series) formats[each.scale || "y"] = each.format;
    const axes = [{ ...line, values: (_, marks) => marks.map((at) => mark(at, marks[1] - marks[0])) }];
    for (const [scale, format] of Object.entries(formats)) {
      axes.push({
        ...line, scale, size: 62, side: scale === "right" ? 1 : 3,
        grid: { ...line.grid, show: scale !== "right" },
        values: (_, marks) => marks.map(format),
      });
    }
    this.plot = new uPlot({
      width: this.width(), height: HEIGHT, axes,
      scales: { x: { time: false }, y: { range: fromZero }, right: { range: fromZero } },
      cursor: { y: false, drag: { x: true, y: false } },
      series: [
        { label: "Time", value: (_, at) => (at === null ? "–" : mark(at, 0.1)) },
        ...this.series.map((each) => ({
          label: each.label, stroke: each.colour, width: 1.5, scale: each.scale || "y", points: { show: false },
          value: (_, value) => each.format(value),
        })),
      ],
    }, this.data, this.place);
  }

  width() {
    return Math.max(200, this.place.clientWidth);
  }

  resize() {
    if (this.plot.width !== this.width()) this.plot.setSize({ width: this.width(), height: HEIGHT });
  }

  draw(data) {
    this.data = data;
    const { min, max } = this.plot.scales.x;
    const before = this.plot.data[0];
    const isZoomed = before.length > 1 && (min > before[0] || max < before.at(-1));
    this.plot.setData(data, !isZoomed);
    if (isZoomed) this.plot.redraw();
    whenOpen(this.table, () => this.fillTable());
  }

  fillTable() {
    const columns = [["time", "number"], ...this.series.map((each) => [each.label, "number"])];
    const last = this.data[0].length - 1;
    const rows = [];
    for (let at = last; at >= 0 && rows.length < ROWS; at -= 1) {
      const values = this.series.map((each, index) => each.format(this.data[index + 1][at]));
      rows.push([mark(this.data[0][at], 0.1), ...values]);
    }
    fill(this.table, columns, rows, "nothing yet");
  }
}

function fromZero(_, min, max) {
  return [0, max > 0 ? max * 1.08 : 1];
}
