// The points of one pair of pictures, with undo. It knows no page and no server.
//
// A point is {name, a, b}; a and b are [x, y] in pixels, or null where it is not marked. Points are
// never changed in place, so that the history can keep them.

export const SIDES = ["a", "b"];
export const other = (side) => (side === "a" ? "b" : "a");
export const groupOf = (name) => name.replace(/_?\d+$/, "");
export const groupClass = (name) => `group-${groupOf(name).replace(/[^\w-]/g, "")}`;
const HISTORY = 500;

export class Marks {
  constructor(points) {
    this.points = points;
    this.past = [];
    this.future = [];
    this.lastAction = null;
  }

  // Changes with the same action in a row, as of one drag, are undone in one step.
  become(points, action = null) {
    if (action === null || action !== this.lastAction) {
      this.past.push(this.points);
      this.past.splice(0, this.past.length - HISTORY);
    }
    this.future = [];
    this.lastAction = action;
    this.points = points;
  }

  endAction() {
    this.lastAction = null;
  }

  undo() {
    return this.#step(this.past, this.future);
  }

  redo() {
    return this.#step(this.future, this.past);
  }

  #step(from, to) {
    if (!from.length) return false;
    to.push(this.points);
    this.points = from.pop();
    this.lastAction = null;
    return true;
  }

  set(index, change, action = null) {
    this.become(this.points.map((p, i) => (i === index ? { ...p, ...change } : p)), action);
  }

  // Move point `index`, its group or all points on one side, but none outside the picture.
  move(index, side, [dx, dy], scope, size, action) {
    const group = groupOf(this.points[index].name);
    const moves = (p, i) =>
      p[side] && (i === index || scope === "all" || (scope === "group" && groupOf(p.name) === group));
    const chosen = this.points.filter(moves).map((p) => p[side]);
    if (!chosen.length) return;
    const step = [0, 1].map((k) => {
      const values = chosen.map((at) => at[k]);
      const wanted = [dx, dy][k];
      return Math.max(-Math.min(...values), Math.min(wanted, size[k] - 1 - Math.max(...values)));
    });
    const carried = ([x, y]) => [rounded(x + step[0]), rounded(y + step[1])];
    this.become(
      this.points.map((p, i) => (moves(p, i) ? { ...p, [side]: carried(p[side]) } : p)),
      action,
    );
  }

  // Add a point in one picture; its index.
  add(side, at) {
    const names = new Set(this.points.map((p) => p.name));
    let number = 1;
    while (names.has(`extra_${number}`)) number += 1;
    const point = { name: `extra_${number}`, a: null, b: null, [side]: at };
    this.become([...this.points, point]);
    return this.points.length - 1;
  }

  remove(index) {
    this.become(this.points.filter((_, i) => i !== index));
  }

  // Take a point out of one picture; it goes away when it was in no other.
  unpair(index, side) {
    if (this.points[index][other(side)]) this.set(index, { [side]: null });
    else this.remove(index);
  }

  // Give an unpaired point its partner: the nearest unpaired point of the other picture, or a new
  // one where the pairs suggest. Its index afterwards.
  pair(index, sizes) {
    const point = this.points[index];
    const side = point.a ? "a" : "b";
    const there = other(side);
    const likely = this.guess(point[side], side, sizes);
    const free = this.points
      .map((p, i) => ({ at: p[there], i, single: p[there] && !p[side] }))
      .filter((p) => p.single)
      .sort((p, q) => distance(p.at, likely) - distance(q.at, likely))[0];
    const paired = { ...point, [there]: free ? free.at : likely };
    const points = this.points.map((p, i) => (i === index ? paired : p));
    this.become(points.filter((_, i) => i !== free?.i));
    return this.points.indexOf(paired);
  }

  // Where `at` of one picture should be in the other: displaced as its neighbours are.
  guess(at, side, sizes) {
    const there = other(side);
    const size = sizes[there];
    const pairs = this.points.filter((p) => p.a && p.b);
    let found = [0, 1].map((k) => (at[k] / sizes[side][k]) * size[k]);
    if (pairs.length) {
      const weights = pairs.map((p) => 1 / (distance(p[side], at) ** 2 + 1e-6));
      const total = weights.reduce((sum, w) => sum + w, 0);
      found = [0, 1].map(
        (k) => at[k] + pairs.reduce((s, p, i) => s + weights[i] * (p[there][k] - p[side][k]), 0) / total,
      );
    }
    return found.map((v, k) => rounded(Math.min(Math.max(v, 0), size[k] - 1)));
  }
}

export const isUnpaired = (point) => !point.a || !point.b;
export const rounded = (value) => Math.round(value * 100) / 100;

function distance(p, q) {
  return Math.hypot(p[0] - q[0], p[1] - q[1]);
}
