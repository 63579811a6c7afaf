// Bifurcation curves in the plane of two parameters, over the run's atlas or the number of its attractors.

import { Atlas } from "./atlas.js";
import { card, el, show } from "./dom.js";
import { number } from "./facts.js";
import { extent, Frame } from "./frame.js";

/** How far a click may be from a curve [px]. */
const REACH = 14;

/** Opacity of curves whose orbits are unstable on both sides. */
const PALE = 0.35;

/** Dashes of each kind of bifurcation, as in the figures. */
const DASHES = { fold: [], "period doubling": [6, 3], "Neimark-Sacker": [1.5, 3] };

export class ParameterPlane {
  /**
   * @param {Object} state of `createState`; a click sets `curvePoint`
   * @param {Object} source
   * @param {Object} view
   * @param {Object} diagram which knows the sections that are left out
   */
  constructor(state, source, view, diagram) {
    Object.assign(this, { state, source, diagram, found: null, chosen: null, atlas: null });
    const { element, body } = card(view.has.atlas ? "Atlas of two parameters" : "Curves of bifurcations", "parameter-plane");
    this.element = element;
    this.readout = el("output", { class: "readout" });
    this.legend = el("ul", { class: "legend" });
    this.note = el("p", { class: "note", role: "status" });
    this.frame = new Frame(body, { label: "Curves of bifurcations in the plane of two parameters", ratio: 0.6 });
    this.frame.paintBack = (ctx, frame, colours) => this.paint(ctx, frame, colours);
    this.frame.paintFront = (ctx, frame, colours) => this.paintChosen(ctx, frame, colours);
    this.body = body;
    body.append(this.readout, this.legend, this.note);
    this.listen();
    const known = Boolean(view.has.curves && source.parameterPlane);
    show(element, known);
    if (known) this.load();
  }

  destroy() {
    this.frame.destroy();
  }

  async load() {
    try {
      this.take(await this.source.parameterPlane());
    } catch (error) {
      this.note.textContent = error.message;
    }
  }

  take(found) {
    this.found = found;
    this.note.textContent = found.note ?? "Click a curve, or choose a point with the arrow keys: its orbit is shown.";
    if (found.note) return;
    const { curves, points, map } = found;
    this.atlas = found.atlas && new Atlas(found.atlas, this);
    if (this.atlas) {
      this.body.append(this.atlas.element);
      this.note.textContent = "Click a region, a curve or a cross: its orbits are shown. Arrow keys go along curves.";
    }
    let [x0, x1] = [Infinity, -Infinity], [y0, y1] = [Infinity, -Infinity];
    for (const { x, y } of [...curves, ...(this.atlas?.outlines ?? []), ...(map ? [map] : [])]) [[x0, x1], [y0, y1]] = [extent(x, x0, x1), extent(y, y0, y1)];
    [this.frame.xAxis, this.frame.yAxis] = found.axes.map(({ label }) => ({ label, angle: false }));
    this.frame.fit(x0, x1, y0, y1, 0.02);
    this.image = map && imageOf(map);
    const kinds = [...new Set(curves.map((curve) => curve.kind))].map((kind) => el("li", {}, sample(kind), kind));
    const shades = map ? map.colours.map((colour, n) => [n, colour]).filter(([n]) => map.number.includes(n)) : [];
    const numbers = shades.map(([n, colour]) => {
      const swatch = el("span", { class: "swatch", "aria-hidden": "true" });
      swatch.style.background = colour;
      return el("li", {}, swatch, n === 1 ? "1 attractor" : `${n} attractors`);
    });
    const marks = points.length ? [el("li", { text: `● points of codimension two: ${points.length}` })] : [];
    this.legend.replaceChildren(...kinds, ...numbers, ...(this.atlas?.legend ?? []), ...marks);
    this.frame.repaint();
  }

  // ---- pointing ----------------------------------------------------------------------------

  listen() {
    const { front } = this.frame;
    this.frame.element.classList.add("takes-pointer");
    front.tabIndex = 0;
    front.setAttribute("role", "application");
    front.addEventListener("pointermove", (event) => this.tell(this.nearest(event)));
    front.addEventListener("click", (event) => this.choose(this.nearest(event)));
    front.addEventListener("keydown", (event) => this.key(event));
  }

  /** The point of a curve nearest to a pointer, or what of the atlas is there; null if nothing is. */
  nearest(event) {
    const place = this.found?.curves && this.frame.at(event);
    if (!place) return null;
    const [px, py] = [this.frame.x(place[0]), this.frame.y(place[1])];
    const mark = this.atlas?.markAt(px, py);
    if (mark) return mark;
    const lines = (this.atlas?.lines ?? []).map(({ x, y }, line) => ({ x, y, line }));
    let best = null, least = REACH;
    for (const { id, x, y, line } of [...this.found.curves, ...lines]) {
      for (let i = 0; i < x.length; i++) {
        const away = distance(px, py, this.at(x, y, i), this.at(x, y, Math.min(i + 1, x.length - 1)));
        if (away < least) [best, least] = [line === undefined ? { curve: id, point: i } : { line }, away];
      }
    }
    return best ?? this.atlas?.regionAt(place) ?? null;
  }

  at(x, y, i) {
    return [this.frame.x(x[i]), this.frame.y(y[i])];
  }

  key(event) {
    const curves = this.found?.curves ?? [], steps = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [1, 0], ArrowDown: [-1, 0] };
    if (!curves.length || !(event.key in steps)) return;
    event.preventDefault();
    event.stopPropagation();
    const [across, along] = steps[event.key], { curve, point } = this.chosen ?? { curve: 0, point: -along };
    const next = (curve + across + curves.length) % curves.length;
    const last = curves[next].x.length - 1;
    this.choose({ curve: next, point: Math.min(Math.max(point + along * (event.shiftKey ? 10 : 1), 0), last) });
  }

  choose(chosen) {
    if (!chosen || chosen.line !== undefined) return;
    this.tell(chosen);
    this.chosen = chosen.curve === undefined ? null : chosen;
    if (!this.chosen) return this.atlas.choose(chosen);
    this.atlas?.forget();
    this.frame.refresh();
    this.state.set({ curvePoint: chosen });
  }

  tell(chosen) {
    if (!chosen) return;
    if (chosen.curve === undefined) {
      this.readout.textContent = this.atlas.text(chosen);
      return;
    }
    const { kind, period, x, y } = this.found.curves[chosen.curve], [first, second] = this.found.axes;
    const values = `${first.name} = ${number(x[chosen.point], 7)}, ${second.name} = ${number(y[chosen.point], 7)}`;
    this.readout.textContent = `${kind}, ${period ? `period ${period}` : "equilibrium"}: ${values}`;
  }

  // ---- painting ----------------------------------------------------------------------------

  paint(ctx, frame, colours) {
    if (!this.found?.axes.length) return;
    this.atlas?.paintRegions(ctx, frame);
    if (this.image) {
      const [x0, x1, y0, y1] = this.image.box;
      ctx.imageSmoothingEnabled = false;
      ctx.drawImage(this.image.canvas, frame.x(x0), frame.y(y1), frame.x(x1) - frame.x(x0), frame.y(y0) - frame.y(y1));
    }
    for (const [width, colour] of [[3, colours.card], [1.4, colours.ink]]) {
      ctx.lineWidth = width;
      ctx.strokeStyle = colour;
      for (const { kind, x, y, pale } of this.found.curves) {
        ctx.setLineDash(colour === colours.ink ? DASHES[kind] ?? [] : []);
        for (const [isPale, from, to] of stretches(pale, x.length)) {
          ctx.globalAlpha = isPale ? PALE : 1;
          frame.trace(ctx, [x.slice(from, to).flatMap((value, i) => [value, y[from + i]])]);
          ctx.stroke();
        }
      }
    }
    ctx.globalAlpha = 1;
    ctx.setLineDash([]);
    this.atlas?.paintLines(ctx, frame, colours);
    ctx.textBaseline = "bottom";
    ctx.textAlign = "left";
    for (const { x, y, label } of this.found.points) {
      const [px, py] = [frame.x(x), frame.y(y)];
      ctx.beginPath();
      ctx.arc(px, py, 3.5, 0, 2 * Math.PI);
      ctx.fillStyle = colours.ink;
      ctx.fill();
      ctx.lineWidth = 3;
      ctx.strokeStyle = colours.card;
      ctx.strokeText(label, px + 5, py - 3);
      ctx.fillText(label, px + 5, py - 3);
    }
  }

  paintChosen(ctx, frame, colours) {
    this.atlas?.paintChosen(ctx, frame, colours);
    if (!this.chosen) return;
    const { x, y } = this.found.curves[this.chosen.curve];
    ctx.beginPath();
    ctx.arc(...this.at(x, y, this.chosen.point), 7, 0, 2 * Math.PI);
    for (const [width, colour] of [[5, colours.card], [2.4, colours.accent]]) {
      ctx.lineWidth = width;
      ctx.strokeStyle = colour;
      ctx.stroke();
    }
  }
}

/** Stretches of a curve: whether its orbits are unstable on both sides, the first point, and the last plus one. */
function stretches(pale, n) {
  if (!pale) return [[false, 0, n]];
  const found = [];
  for (let from = 0, to; from < n - 1; from = to) {
    const isPale = pale[from] || pale[from + 1];
    for (to = from + 1; to < n - 1 && (pale[to] || pale[to + 1]) === isPale; to++);
    found.push([isPale, from, to + 1]);
  }
  return found;
}

/** A picture of the map, a pixel for each point, and the box of its edges. */
function imageOf({ x, y, number: counts, colours }) {
  const canvas = el("canvas");
  [canvas.width, canvas.height] = [x.length, y.length];
  const ctx = canvas.getContext("2d");
  counts.forEach((count, k) => {
    ctx.fillStyle = colours[count];
    ctx.fillRect(k % x.length, y.length - 1 - Math.floor(k / x.length), 1, 1);
  });
  return { canvas, box: [...edges(x), ...edges(y)] };
}

function edges(values) {
  const half = values.length > 1 ? (values.at(-1) - values[0]) / (values.length - 1) / 2 : 0.5;
  return [values[0] - half, values.at(-1) + half];
}

/** A short line with the dashes of a kind. */
function sample(kind) {
  const line = el("span", { class: "dash-sample", "aria-hidden": "true" });
  line.style.borderTopStyle = { fold: "solid", "period doubling": "dashed" }[kind] ?? "dotted";
  return line;
}

/** Distance of a place from a segment. */
function distance(px, py, [ax, ay], [bx, by]) {
  const [dx, dy] = [bx - ax, by - ay], length = dx * dx + dy * dy;
  const share = length ? Math.min(1, Math.max(0, ((px - ax) * dx + (py - ay) * dy) / length)) : 0;
  return Math.hypot(px - ax - share * dx, py - ay - share * dy);
}
