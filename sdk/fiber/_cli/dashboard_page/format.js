// Figures as text.

const MANY = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });
const FEW = new Intl.NumberFormat("en", { maximumSignificantDigits: 3 });
const UNITS = ["B", "KB", "MB", "GB", "TB", "PB"];

export function number(value) {
  if (value === null || value === undefined) return "–";
  return Math.abs(value) < 100 ? FEW.format(value) : MANY.format(value);
}

export function bytes(value) {
  if (value === null || value === undefined) return "–";
  let unit = 0;
  while (value >= 1000 && unit < UNITS.length - 1) {
    value /= 1000;
    unit += 1;
  }
  return `${FEW.format(value)} ${UNITS[unit]}`;
}

export function seconds(value) {
  if (value === null || value === undefined) return "–";
  if (value < 1e-3) return `${FEW.format(value * 1e6)} µs`;
  if (value < 1) return `${FEW.format(value * 1e3)} ms`;
  if (value < 120) return `${FEW.format(value)} s`;
  const minutes = Math.floor(value / 60);
  if (minutes < 120) return `${minutes} min ${Math.floor(value % 60)} s`;
  return `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

// The mark of an axis of time: as short as it can be.
export function mark(value, step) {
  if (value < 120) return `${Number(value.toFixed(Number.isInteger(step) ? 0 : 3))} s`;
  const minutes = Math.floor(value / 60);
  const rest = Math.round(value % 60);
  if (value < 7200) return rest ? `${minutes}:${String(rest).padStart(2, "0")} min` : `${minutes} min`;
  return `${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, "0")} h`;
}
