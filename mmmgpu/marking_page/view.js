// One picture with points on it, in an SVG: zoom, pan, drag. What it shows is given; what a person
// does to it is told to `listener`: select(index), drag(index, delta), dragged(), place(at), look().

import { groupClass, groupOf, isUnpaired } from "./marks.js";

const SVG = "http://www.w3.org/2000/svg";
const NEAR = 3; // screen pixels per picture pixel from which single pixels are shown
const LEAST = 8; // picture pixels across, when zoomed in as far as possible
const CLOSED_LINES = ["outer_lip", "inner_lip"];
const OPEN_LINES = ["nose", "jaw"];

function element(name, attributes = {}, parent = null) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  parent?.append(made);
  return made;
}

export class View {
  constructor(svg, side, listener = null) {
    this.svg = svg;
    this.side = side;
    this.listener = listener;
    this.size = [1, 1];
    this.look = { x: 0, y: 0, width: 1 }; // centre, and picture pixels across
    this.picture = element("image", { preserveAspectRatio: "none" }, svg);
    this.overlay = element("image", { preserveAspectRatio: "none", opacity: 0 }, svg);
    this.lines = element("g", {}, svg);
    this.markers = element("g", {}, svg);
    this.points = [];
    new ResizeObserver(() => this.redraw()).observe(svg);
    if (listener) this.#listen();
  }

  // Show another picture of [width, height] pixels. Centres of pixels lie at whole numbers.
  show(address, size) {
    this.size = size;
    for (const image of [this.picture, this.overlay]) {
      const place = { x: -0.5, y: -0.5, width: size[0], height: size[1] };
      for (const [key, value] of Object.entries(place)) image.setAttribute(key, value);
    }
    if (address) this.picture.setAttribute("href", address);
  }

  get scale() {
    return this.svg.clientWidth / this.look.width; // screen pixels per picture pixel
  }

  get height() {
    return (this.look.width * this.svg.clientHeight) / Math.max(this.svg.clientWidth, 1);
  }

  whole() {
    this.#frame([-0.5, -0.5, this.size[0] - 0.5, this.size[1] - 0.5], 1.02);
  }

  // Show the points [x, y] with some margin.
  fit(points) {
    if (!points.length) return this.whole();
    const xs = points.map((p) => p[0]);
    const ys = points.map((p) => p[1]);
    this.#frame([Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)], 1.25);
  }

  #frame([left, top, right, bottom], margin) {
    const aspect = this.svg.clientWidth / Math.max(this.svg.clientHeight, 1);
    const width = Math.max(right - left, (bottom - top) * aspect, LEAST) * margin;
    this.#lookAt((left + right) / 2, (top + bottom) / 2, width);
  }

  // Zoom by `factor` so that the point [x, y] of the picture stays where it is.
  zoom(factor, [x, y] = [this.look.x, this.look.y]) {
    const width = Math.min(Math.max(this.look.width / factor, LEAST), 4 * Math.max(...this.size));
    const share = width / this.look.width;
    this.#lookAt(x + (this.look.x - x) * share, y + (this.look.y - y) * share, width);
  }

  // Move the view by a part of what it shows.
  pan(right, down) {
    this.#lookAt(this.look.x + right * this.look.width, this.look.y + down * this.height, this.look.width);
  }

  // Move the view as little as needed for [x, y] to be seen well inside.
  reveal([x, y]) {
    const reach = [0.42 * this.look.width, 0.42 * this.height];
    const near = (centre, at, r) => Math.min(Math.max(centre, at - r), at + r);
    this.#lookAt(near(this.look.x, x, reach[0]), near(this.look.y, y, reach[1]), this.look.width);
  }

  #lookAt(x, y, width) {
    const inside = (value, size) => Math.min(Math.max(value, 0), size - 1);
    this.look = { x: inside(x, this.size[0]), y: inside(y, this.size[1]), width };
    this.redraw();
    this.listener?.look?.(this);
  }

  // Look where another view of the same picture looks, as far across.
  follow(view) {
    this.look = { ...view.look };
    this.redraw();
  }

  // Picture coordinates of a place on the screen.
  at(event) {
    const box = this.svg.getBoundingClientRect();
    return [
      this.look.x + (event.clientX - box.left - box.width / 2) / this.scale,
      this.look.y + (event.clientY - box.top - box.height / 2) / this.scale,
    ];
  }

  draw(points, selected, folded) {
    this.points = points;
    this.markers.replaceChildren();
    points.forEach((point, i) => {
      if (point[this.side]) this.#drawMarker(point, i, i === selected, folded.has(point.name));
    });
    this.svg.setAttribute("aria-activedescendant", points[selected]?.[this.side] ? this.#id(selected) : "");
    this.#drawLines();
    this.redraw();
  }

  #id(index) {
    return `${this.side}-${index}`;
  }

  #drawMarker(point, index, isSelected, isFolded) {
    const [x, y] = point[this.side];
    const state = [
      isUnpaired(point) && "unpaired",
      isFolded && "folded",
      isSelected && "selected",
    ].filter(Boolean);
    const marker = element("g", {
      id: this.#id(index),
      class: ["point", groupClass(point.name), ...state].join(" "),
      role: "img",
      "aria-label": [point.name, `x ${x}, y ${y}`, ...state].join(", "),
    }, this.markers);
    marker.dataset.index = index;
    element("circle", { class: "reach", r: 11 }, marker);
    element("circle", { class: "edge", r: 5 }, marker);
    element("circle", { class: "ring", r: 5 }, marker);
    element("path", { class: "cross", d: "M-13,0H-8M8,0H13M0,-13V-8M0,8V13" }, marker);
    element("circle", { class: "spot", r: 1.2 }, marker);
    element("text", { x: 10, y: -8 }, marker).textContent = point.name;
  }

  #drawLines() {
    this.lines.replaceChildren();
    for (const group of [...CLOSED_LINES, ...OPEN_LINES]) {
      const members = this.points.filter((p) => groupOf(p.name) === group && p[this.side]);
      if (members.length < 2) continue;
      const line = members.map((p) => p[this.side].join(",")).join("L");
      element("path", { class: "join", d: `M${line}${CLOSED_LINES.includes(group) ? "Z" : ""}` }, this.lines);
    }
  }

  // Bring view box and markers up to the zoom: markers keep their size on the screen.
  redraw() {
    const { x, y, width } = this.look;
    if (!this.svg.clientWidth) return;
    this.svg.setAttribute("viewBox", `${x - width / 2} ${y - this.height / 2} ${width} ${this.height}`);
    const near = this.scale >= NEAR ? "near" : "";
    for (const image of [this.picture, this.overlay]) image.setAttribute("class", near);
    for (const marker of this.markers.children) {
      const [px, py] = this.points[marker.dataset.index][this.side];
      marker.setAttribute("transform", `translate(${px} ${py}) scale(${1 / this.scale})`);
    }
  }

  #listen() {
    const { svg, listener } = this;
    let held = null;
    svg.addEventListener("pointerdown", (event) => {
      if (event.button > 1) return;
      const index = event.target.closest(".point")?.dataset.index;
      held = { index: index === undefined ? null : Number(index), from: this.at(event), moved: false };
      svg.focus({ preventScroll: true });
      svg.setPointerCapture(event.pointerId);
      if (held.index !== null) listener.select(held.index);
      event.preventDefault();
    });
    svg.addEventListener("pointermove", (event) => {
      if (!held) return;
      const to = this.at(event);
      const step = [to[0] - held.from[0], to[1] - held.from[1]];
      if (!held.moved && Math.hypot(...step) * this.scale < 3) return;
      held.moved = true;
      svg.classList.add("dragging");
      if (held.index === null) {
        this.#lookAt(this.look.x - step[0], this.look.y - step[1], this.look.width);
      } else {
        listener.drag(held.index, step);
        held.from = to;
      }
    });
    const release = (event) => {
      if (!held) return;
      svg.classList.remove("dragging");
      if (held.moved) listener.dragged();
      else if (held.index === null && event.type === "pointerup") listener.place(this.at(event));
      held = null;
    };
    svg.addEventListener("pointerup", release);
    svg.addEventListener("pointercancel", release);
    svg.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY / 400), this.at(event));
    }, { passive: false });
  }
}
