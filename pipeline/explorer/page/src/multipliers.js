// Floquet multipliers in the complex plane with the unit circle; each value by hover, touch or focus.

import { el } from "./dom.js";
import { Frame } from "./frame.js";

export class Multipliers {
  constructor(body) {
    this.values = [];
    this.chosen = -1;
    this.frame = new Frame(body, { label: "Floquet multipliers", ratio: 0.85, equal: true });
    this.frame.xAxis = { label: "real part", angle: false };
    this.frame.yAxis = { label: "imaginary part", angle: false };
    this.frame.paintBack = (ctx, frame, colours) => this.paint(ctx, frame, colours);
    this.frame.paintFront = (ctx, frame, colours) => this.paintChosen(ctx, frame, colours);
    this.list = el("ul", { class: "values" });
    this.note = el("p", { class: "note" });
    body.append(this.list, this.note);
    this.frame.front.addEventListener("pointermove", (event) => this.point(event));
    this.frame.front.addEventListener("pointerdown", (event) => this.point(event));
  }

  destroy() {
    this.frame.destroy();
  }

  show(orbit) {
    this.values = orbit.attrs.multipliers ?? [];
    this.chosen = -1;
    const known = this.values.length > 0;
    this.frame.element.hidden = this.list.hidden = !known;
    this.note.textContent = known ? "" : absence(orbit.attrs);
    const items = this.values.map((value, k) => el("li", {}, el("button", {
      type: "button", class: "value", text: told(value),
      on: { focus: () => this.choose(k), pointerenter: () => this.choose(k), blur: () => this.choose(-1) },
    })));
    this.list.replaceChildren(...items);
    const reach = Math.max(1, ...this.values.map(([re, im]) => Math.hypot(re, im)));
    this.frame.fit(-reach, reach, -reach, reach, 0.15);
    this.frame.setLabel(`Floquet multipliers: ${this.values.map(told).join("; ")}`);
    this.frame.measure();
  }

  choose(k) {
    this.chosen = k;
    [...this.list.children].forEach((item, i) => item.classList.toggle("chosen", i === k));
    this.frame.refresh();
  }

  point(event) {
    const place = this.frame.at(event);
    if (!place) return this.choose(-1);
    const scale = (this.frame.limits[1] - this.frame.limits[0]) / this.frame.box.width;
    let best = -1, least = 24 * scale;
    this.values.forEach(([re, im], k) => {
      const distance = Math.hypot(re - place[0], im - place[1]);
      if (distance < least) [best, least] = [k, distance];
    });
    return this.choose(best);
  }

  paint(ctx, frame, colours) {
    ctx.beginPath();
    ctx.arc(frame.x(0), frame.y(0), Math.abs(frame.x(1) - frame.x(0)), 0, 2 * Math.PI);
    ctx.strokeStyle = colours.ink;
    ctx.lineWidth = 1.4;
    ctx.stroke();
    for (const [re, im] of this.values) {
      const outside = Math.hypot(re, im) > 1;
      ctx.beginPath();
      const [px, py] = [frame.x(re), frame.y(im)];
      // a cross outside, a disc inside: colour is not the only sign
      if (outside) {
        ctx.moveTo(px - 5, py - 5);
        ctx.lineTo(px + 5, py + 5);
        ctx.moveTo(px + 5, py - 5);
        ctx.lineTo(px - 5, py + 5);
        ctx.strokeStyle = colours.warn;
        ctx.lineWidth = 2.4;
        ctx.stroke();
      } else {
        ctx.arc(px, py, 4.5, 0, 2 * Math.PI);
        ctx.fillStyle = colours.accent;
        ctx.fill();
      }
    }
  }

  paintChosen(ctx, frame, colours) {
    if (this.chosen < 0) return;
    const value = this.values[this.chosen], [px, py] = [frame.x(value[0]), frame.y(value[1])];
    ctx.beginPath();
    ctx.arc(px, py, 9, 0, 2 * Math.PI);
    ctx.strokeStyle = colours.ink;
    ctx.lineWidth = 2;
    ctx.stroke();
    const text = told(value), width = ctx.measureText(text).width;
    const left = Math.min(Math.max(frame.box.left + 4, px - width / 2), frame.box.left + frame.box.width - width - 8);
    const top = py < frame.box.top + 40 ? py + 14 : py - 32;
    ctx.fillStyle = colours.card;
    ctx.fillRect(left - 4, top, width + 8, 18);
    ctx.fillStyle = colours.ink;
    ctx.textBaseline = "middle";
    ctx.fillText(text, left, top + 9);
  }
}

/** Why there are no multipliers. */
function absence({ period, note }) {
  if (!period) return "None: this motion is not periodic.";
  return note ? "They are not known yet." : "They are not known: the orbit was not found to the last digits, or its attractor has not been analysed.";
}

/** A multiplier in words: its parts and its size. */
export function told([re, im]) {
  const part = (value) => value.toPrecision(4).replace("-", "−");
  const size = Math.hypot(re, im).toPrecision(4);
  if (Math.abs(im) < 1e-12) return `${part(re)} (size ${size})`;
  return `${part(re)} ${im < 0 ? "−" : "+"} ${Math.abs(im).toPrecision(4)}i (size ${size})`;
}
