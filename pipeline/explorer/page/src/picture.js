// A picture to keep: the same painting as on the page, into a PNG of twice the pixels or into an SVG.

/** What a canvas's context can do of which pictures here make use, written as SVG. */
export class SvgContext {
  constructor(width, height) {
    [this.width, this.height] = [width, height];
    this.parts = [];
    this.path = "";
    this.clips = 0;
    this.open = [0];
    this.stack = [];
    this.matrix = [1, 0, 0, 1, 0, 0];
    Object.assign(this, {
      fillStyle: "#000000", strokeStyle: "#000000", lineWidth: 1, font: "12px sans-serif", textAlign: "start",
      textBaseline: "alphabetic", globalAlpha: 1, lineJoin: "miter", lineCap: "butt", dash: [], imageSmoothingEnabled: true,
    });
  }

  save() {
    const kept = {};
    for (const key of ["fillStyle", "strokeStyle", "lineWidth", "font", "textAlign", "textBaseline", "globalAlpha", "lineJoin", "lineCap", "dash", "matrix"]) kept[key] = this[key];
    this.stack.push(kept);
    this.open.push(0);
  }

  restore() {
    this.parts.push("</g>".repeat(this.open.pop()));
    Object.assign(this, this.stack.pop());
  }

  translate(x, y) {
    this.transform(1, 0, 0, 1, x, y);
  }

  scale(x, y) {
    this.transform(x, 0, 0, y, 0, 0);
  }

  rotate(angle) {
    this.transform(Math.cos(angle), Math.sin(angle), -Math.sin(angle), Math.cos(angle), 0, 0);
  }

  transform(a, b, c, d, e, f) {
    const [p, q, r, s, t, u] = this.matrix;
    this.matrix = [p * a + r * b, q * a + s * b, p * c + r * d, q * c + s * d, p * e + r * f + t, q * e + s * f + u];
  }

  setLineDash(dash) {
    this.dash = [...dash];
  }

  beginPath() {
    this.path = "";
  }

  closePath() {
    this.path += "Z";
  }

  moveTo(x, y) {
    this.path += `M${this.point(x, y)}`;
  }

  lineTo(x, y) {
    this.path += `${this.path ? "L" : "M"}${this.point(x, y)}`;
  }

  rect(x, y, width, height) {
    this.path += `M${this.point(x, y)}L${this.point(x + width, y)}L${this.point(x + width, y + height)}L${this.point(x, y + height)}Z`;
  }

  arc(x, y, radius, from, to) {
    const size = Math.hypot(this.matrix[0], this.matrix[1]) * radius, around = Math.abs(to - from) >= 2 * Math.PI - 1e-9;
    const at = (angle) => this.point(x + radius * Math.cos(angle), y + radius * Math.sin(angle));
    const ends = around ? [from + Math.PI, from + 2 * Math.PI] : [to];
    this.path += `${this.path && !around ? "L" : "M"}${at(from)}`;
    for (const end of ends) this.path += `A${number(size)} ${number(size)} 0 ${!around && to - from > Math.PI ? 1 : 0} 1 ${at(end)}`;
    if (around) this.path += "Z";
  }

  point(x, y) {
    const [a, b, c, d, e, f] = this.matrix;
    return `${number(a * x + c * y + e)} ${number(b * x + d * y + f)}`;
  }

  clip() {
    const id = `clip${++this.clips}`;
    this.parts.push(`<clipPath id="${id}"><path d="${this.path}"/></clipPath><g clip-path="url(#${id})">`);
    this.open[this.open.length - 1] += 1;
  }

  stroke() {
    const size = Math.hypot(this.matrix[0], this.matrix[1]);
    const dash = this.dash.length ? ` stroke-dasharray="${this.dash.map((part) => number(part * size)).join(" ")}"` : "";
    this.parts.push(`<path d="${this.path}" fill="none" stroke="${escaped(this.strokeStyle)}" stroke-width="${number(this.lineWidth * size)}"` +
      ` stroke-linejoin="${this.lineJoin}" stroke-linecap="${this.lineCap}"${dash}${this.opacity()}/>`);
  }

  fill() {
    this.parts.push(`<path d="${this.path}" fill="${escaped(this.fillStyle)}"${this.opacity()}/>`);
  }

  strokeRect(x, y, width, height) {
    const kept = this.path;
    this.path = "";
    this.rect(x, y, width, height);
    this.stroke();
    this.path = kept;
  }

  fillRect(x, y, width, height) {
    const kept = this.path;
    this.path = "";
    this.rect(x, y, width, height);
    this.fill();
    this.path = kept;
  }

  clearRect() {}

  fillText(text, x, y) {
    const anchor = { center: "middle", right: "end", end: "end" }[this.textAlign] ?? "start";
    const size = parseFloat(this.font.match(/([\d.]+)px/)?.[1] ?? "12"), family = this.font.replace(/^.*?px\s*/, "");
    const drop = { top: 0.8, hanging: 0.8, middle: 0.35, bottom: -0.2 }[this.textBaseline] ?? 0;
    const weight = /\b(bold|[5-9]00)\b/.test(this.font) ? ' font-weight="bold"' : "";
    this.parts.push(`<text transform="matrix(${this.matrix.map(number).join(" ")})" x="${number(x)}" y="${number(y + drop * size)}"` +
      ` font-size="${size}" font-family="${escaped(family)}"${weight} text-anchor="${anchor}" fill="${escaped(this.fillStyle)}"${this.opacity()}>${escaped(text)}</text>`);
  }

  measureText(text) {
    return { width: 0.55 * parseFloat(this.font.match(/([\d.]+)px/)?.[1] ?? "12") * String(text).length };
  }

  /** An image by its data address: a canvas, or what `addressOf` made of a bitmap. */
  drawImage(image, x, y, width, height) {
    const address = image.toDataURL ? image.toDataURL("image/png") : image.src;
    this.parts.push(`<image transform="matrix(${this.matrix.map(number).join(" ")})" x="${number(x)}" y="${number(y)}"` +
      ` width="${number(width ?? image.width)}" height="${number(height ?? image.height)}" preserveAspectRatio="none" href="${address}"/>`);
  }

  opacity() {
    return this.globalAlpha < 1 ? ` opacity="${number(this.globalAlpha)}"` : "";
  }

  text() {
    return `<svg xmlns="http://www.w3.org/2000/svg" width="${this.width}" height="${this.height}" viewBox="0 0 ${this.width} ${this.height}">` +
      `${this.parts.join("\n")}${"</g>".repeat(this.open[0])}</svg>\n`;
  }
}

function number(value) {
  return String(Math.round(value * 1000) / 1000);
}

function escaped(text) {
  return String(text).replace(/[&<>"]/g, (letter) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[letter]);
}

/** Canvas with a bitmap on it, which both kinds of pictures can draw. */
export function canvasOf(bitmap) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [bitmap.width, bitmap.height];
  canvas.getContext("2d").drawImage(bitmap, 0, 0);
  return canvas;
}

/**
 * Paint a picture to keep.
 * @param {number} width [CSS pixels]
 * @param {number} height
 * @param {function(CanvasRenderingContext2D): (void|Promise)} paint
 * @param {"svg"|"png"} format
 * @param {string} paper colour behind all
 * @returns {Promise<Blob>}
 */
export async function pictureOf(width, height, paint, format, paper) {
  if (format === "svg") {
    const svg = new SvgContext(width, height);
    svg.fillStyle = paper;
    svg.fillRect(0, 0, width, height);
    await paint(svg);
    return new Blob([svg.text()], { type: "image/svg+xml" });
  }
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [2 * width, 2 * height];
  const ctx = canvas.getContext("2d");
  ctx.scale(2, 2);
  ctx.fillStyle = paper;
  ctx.fillRect(0, 0, width, height);
  await paint(ctx);
  return new Promise((resolve, reject) =>
    canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("The browser made no PNG of the picture."))), "image/png"));
}

/** Hand a file to the reader. */
export function download(name, blob) {
  const address = URL.createObjectURL(blob), link = document.createElement("a");
  link.href = address;
  link.download = name;
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(address), 60000);
}

/** Paint a picture and hand it to the reader as NAME.svg or NAME.png. */
export async function savePicture(name, width, height, paint, format, paper = "#ffffff") {
  download(`${name}.${format}`, await pictureOf(width, height, paint, format, paper));
}
