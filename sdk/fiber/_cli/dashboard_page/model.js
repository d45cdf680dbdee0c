// The program's record, merged from what the server sends.  `dashboard_model.py` merges alike.

const MOST_SAMPLES = 1200;
const RATE_SECONDS = 4;

export class Model {
  constructor() {
    this.program = null;
    this.activity = null;
    this.children = new Map();
    this.state = { pools: [], children: [], deaths: [] };
    this.samples = [];
    this.status = { state: "connecting", text: "" };
    this.totals = []; // [time, tasks done] of the last seconds
  }

  apply(update) {
    this.status = update.status;
    if (!update.activity) return;
    this.program = update.program;
    this.state = update.state;
    this.mergeActivity(update.activity);
    if (update.samples) this.samples = update.samples;
    else this.samples.push(update.sample);
    if (this.samples.length > MOST_SAMPLES) {
      this.samples = this.samples.filter((_, at) => at % 2 === 0);
    }
  }

  mergeActivity(activity) {
    if (activity.complete) this.children = new Map();
    for (const child of activity.children) {
      const known = this.children.get(child.id);
      child.spans = followed(known ? known.spans : [], child.spans);
      this.children.set(child.id, child);
    }
    this.activity = activity;
    const totals = this.totals;
    if (totals.length && totals.at(-1)[1] > activity.tasks) totals.length = 0; // another record
    totals.push([activity.now, activity.tasks]);
    while (totals.length > 2 && activity.now - totals[0][0] > RATE_SECONDS) totals.shift();
  }

  // Tasks done a second, over the last seconds.
  rate() {
    const [then, before] = this.totals[0];
    const [now, done] = this.totals.at(-1);
    return now > then ? (done - before) / (now - then) : null;
  }

  sum(key) {
    return this.state.pools.reduce((total, pool) => total + pool[key], 0);
  }

  // The processes of each host by their state, those with most processes first.
  hosts() {
    const found = new Map();
    for (const child of this.state.children) {
      const name = child.host || "(no host yet)";
      const host = found.get(name) || { name, node: child.node, count: 0, states: {}, memory: null, share: null };
      found.set(name, host);
      host.count += 1;
      host.states[child.state] = (host.states[child.state] || 0) + 1;
      for (const key of ["memory", "share"]) {
        if (child[key] !== null && child[key] !== undefined) host[key] = (host[key] || 0) + child[key];
      }
    }
    return [...found.values()].sort((a, b) => b.count - a.count || (a.name < b.name ? -1 : 1));
  }

  // [times, tasks done a second, failed tasks a second]
  rates() {
    const { width, done, failed } = this.activity.rates;
    const now = this.activity.now;
    const times = [], all = [], bad = [];
    const count = Math.max(done.length, Math.floor(now / width));
    for (let at = 0; at < count; at += 1) {
      const end = Math.min((at + 1) * width, now);
      const length = end - at * width;
      if (length < width / 2) break; // too short for a rate
      times.push(end);
      all.push((done[at] || 0) / length);
      bad.push((failed[at] || 0) / length);
    }
    return [times, all, bad];
  }
}

function followed(spans, later) {
  if (!later.length) return spans;
  let at = spans.length;
  while (at && spans[at - 1][0] >= later[0][0]) at -= 1;
  spans.length = at;
  for (const span of later) spans.push(span);
  return spans;
}
