// Points of a diagram counted into the pixels of a bitmap. They are ordered by the horizontal axis, so that a
// window reads its own columns only, and a column of pixels is filled while it is in the processor's cache.

/** First index of ascending values that is not below `bound`. */
export function lowerBound(values, bound, begin = 0, end = values.length) {
  while (begin < end) {
    const middle = (begin + end) >>> 1;
    if (values[middle] < bound) begin = middle + 1;
    else end = middle;
  }
  return begin;
}

/**
 * How far a point reaches in pixels: half its height by the distance from its middle. Few points are discs; many
 * are as high as a pixel, and as wide as their columns are apart.
 */
export function dotShape(count, scale, spacing) {
  const radius = Math.round(count <= 800 ? 3 * scale : count <= 1e4 ? 2 * scale : scale);
  if (count <= 6e4) return Array.from({ length: radius + 1 }, (_, d) => Math.floor(Math.sqrt((radius + 0.3) ** 2 - d * d)));
  return new Array(1 + Math.max(0, Math.min(radius, Math.floor((spacing - 1) / 2)))).fill(0);
}

export class Drawing {
  /**
   * @param {{x: Float64Array, at: Uint32Array, first: Uint32Array, y: Float64Array}} data of api/diagram:
   *   cells sorted by `at`, the points of cell i are y[first[i]] to y[first[i + 1]]
   */
  constructor({ x, at, first, y }) {
    Object.assign(this, { x, at, first, y });
    this.begin = new Uint32Array(x.length + 1);
    for (let i = 0; i < at.length; i++) this.begin[at[i] + 1]++;
    for (let i = 0; i < x.length; i++) this.begin[i + 1] += this.begin[i];
    this.colours = new Uint32Array(at.length);
  }

  /** Colour of each cell: four bytes red, green, blue and 255; 0 for a cell that is not shown. */
  setColours(bytes) {
    this.colours = new Uint32Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 4);
  }

  /** Range of all points. */
  extent() {
    let low = Infinity, high = -Infinity;
    for (let k = 0; k < this.y.length; k++) {
      const value = this.y[k];
      if (value < low) low = value;
      if (value > high) high = value;
    }
    return low <= high ? [low, high] : null;
  }

  /** Columns in a range of the horizontal axis, and how many points they have. */
  columns(x0, x1) {
    const from = lowerBound(this.x, x0);
    let to = lowerBound(this.x, x1, from);
    while (to < this.x.length && this.x[to] <= x1) to++;
    return { from, to, count: this.first[this.begin[to]] - this.first[this.begin[from]] };
  }

  /** Share of the points of some columns that are between the vertical bounds, by a sample of them. */
  shareWithin({ from, to, count }, [, , y0, y1]) {
    const begin = this.first[this.begin[from]], step = Math.max(1, Math.floor(count / 4096)) | 1;
    let seen = 0, within = 0;
    for (let k = begin; k < begin + count; k += step, seen++) if (this.y[k] >= y0 && this.y[k] <= y1) within++;
    return seen ? within / seen : 1;
  }

  /**
   * Draw a window.
   * @param {number[]} bounds x0, x1, y0, y1
   * @param {number} width of the bitmap [pixels]
   * @param {number} height
   * @param {number} scale pixels of the bitmap in one of the page
   * @param {number} [most] number of points drawn at most, about; what is drawn of a cell is its first points
   * @returns {{pixels: Uint8ClampedArray, count: number, part: number}} `part` of the points was drawn
   */
  render(bounds, width, height, scale, most = Infinity) {
    const [x0, x1] = bounds, px = width / (x1 - x0);
    const shown = this.columns(x0, x1), { count } = shown;
    const half = dotShape(count * this.shareWithin(shown, bounds), scale, width / Math.max(1, shown.to - shown.from)), radius = half.length - 1;
    const part = Math.min(1, most / Math.max(1, count)), cells = this.begin[shown.to] - this.begin[shown.from];
    const { from, to } = this.columns(x0 - (radius + 1) / px, x1 + (radius + 1) / px);
    const place = new Int32Array(to - from);
    for (let i = from; i < to; i++) place[i - from] = Math.floor((this.x[i] - x0) * px);
    const column = new Column(bounds, height, {
      half, density: (count * part) / (width * height), bold: Math.max(6, (count * part) / Math.max(1, cells) / 8), reach: Math.round(scale),
    });
    const image = new Uint32Array(width * height);
    let a = from, b = from;
    for (let c = 0; c < width; c++) {
      while (a < to && place[a - from] < c - radius) a++;
      while (b < to && place[b - from] <= c + radius) b++;
      if (a === b) continue;
      for (let i = a; i < b; i++) this.addColumn(column, i, Math.abs(place[i - from] - c), part);
      column.write(image, c, width);
    }
    return { pixels: new Uint8ClampedArray(image.buffer), count, part };
  }

  addColumn(column, i, offset, part) {
    for (let cell = this.begin[i]; cell < this.begin[i + 1]; cell++) {
      const colour = this.colours[cell];
      if (colour === 0) continue;
      const k = this.first[cell], length = this.first[cell + 1] - k;
      column.add(this.y, k, k + Math.ceil(length * part), offset, colour);
    }
  }

  /**
   * The point nearest to a place, in pixels.
   * @returns {{index: number, point: number, x: number, y: number, distance: number}|null} `index` of the cell
   *   among the diagram's
   */
  nearest(bounds, width, height, x, y, reach) {
    const px = width / (bounds[1] - bounds[0]), py = height / (bounds[3] - bounds[2]);
    const { from, to } = this.columns(x - reach / px, x + reach / px);
    let least = reach * reach, found = null;
    for (let i = from; i < to; i++) {
      const dx = (this.x[i] - x) * px;
      for (let cell = this.begin[i]; cell < this.begin[i + 1]; cell++) {
        if (this.colours[cell] === 0) continue;
        for (let k = this.first[cell]; k < this.first[cell + 1]; k++) {
          const dy = (this.y[k] - y) * py, distance = dx * dx + dy * dy;
          if (distance < least) {
            least = distance;
            found = { index: cell, point: k - this.first[cell], x: this.x[i], y: this.y[k], distance: Math.sqrt(distance) };
          }
        }
      }
    }
    return found;
  }

  /** Where a point of a cell is; null if the cell has no such point. */
  locate(index, point) {
    const k = this.first[index] + point;
    if (index >= this.at.length || point < 0 || k >= this.first[index + 1]) return null;
    return { index, point, x: this.x[this.at[index]], y: this.y[k] };
  }

  /** Go from a point to the next one: "left" and "right" to the nearest in the next column that has one. */
  step({ index, point, y }, direction, resolution) {
    const i = this.at[index];
    if (direction === "up" || direction === "down") return this.stepInColumn(i, y, direction === "up" ? 1 : -1, resolution);
    const way = direction === "right" ? 1 : -1;
    for (let next = i + way; next >= 0 && next < this.x.length; next += way) {
      const found = this.closestInColumn(next, (value) => Math.abs(value - y));
      if (found) return found;
    }
    return this.locate(index, point);
  }

  stepInColumn(i, y, way, resolution) {
    return this.closestInColumn(i, (value) => ((value - y) * way > resolution ? (value - y) * way : Infinity));
  }

  closestInColumn(i, distanceOf) {
    let least = Infinity, found = null;
    for (let cell = this.begin[i]; cell < this.begin[i + 1]; cell++) {
      if (this.colours[cell] === 0) continue;
      for (let k = this.first[cell]; k < this.first[cell + 1]; k++) {
        const distance = distanceOf(this.y[k]);
        if (distance < least) {
          least = distance;
          found = { index: cell, point: k - this.first[cell], x: this.x[i], y: this.y[k] };
        }
      }
    }
    return found;
  }

  /** Points in a window with their colours, three numbers each; null if there are more than `most`. */
  points([x0, x1, y0, y1], most) {
    const { from, to } = this.columns(x0, x1), found = [];
    for (let cell = this.begin[from]; cell < this.begin[to]; cell++) {
      if (this.colours[cell] === 0) continue;
      for (let k = this.first[cell]; k < this.first[cell + 1]; k++) {
        if (this.y[k] < y0 || this.y[k] > y1) continue;
        if (found.length === 3 * most) return null;
        found.push(this.x[this.at[cell]], this.y[k], this.colours[cell]);
      }
    }
    return Float64Array.from(found);
  }
}

/** One column of pixels: how many points each has, and the colour of one of them. */
class Column {
  constructor([, , y0, y1], height, { half, density, bold, reach }) {
    Object.assign(this, { height, half, bold, reach, y1, scale: height / (y1 - y0) });
    this.count = new Uint32Array(height);
    this.lot = new Uint32Array(height);
    this.colour = new Uint32Array(height);
    this.opacity = opacities(density * half.reduce((sum, h, d) => sum + (d ? 2 : 1) * (2 * h + 1), 0));
    [this.low, this.high] = [height, -1];
  }

  // of the points in a pixel, that with the largest lot gives its colour: a mixture shows its parts' own
  // colours, and the same ones whenever the same points meet
  add(y, from, to, offset, colour) {
    const { count, lot, colour: colours, height, y1, scale } = this, half = this.half[offset];
    let { low, high } = this;
    for (let k = from; k < to; k++) {
      const row = Math.floor((y1 - y[k]) * scale);
      if (!(row >= -half && row < height + half)) continue;
      const top = row > half ? row - half : 0, bottom = row + half < height ? row + half : height - 1;
      if (top < low) low = top;
      if (bottom > high) high = bottom;
      const drawn = (Math.imul(k, 2654435761) | 1) >>> 0;
      for (let r = top; r <= bottom; r++) {
        count[r]++;
        if (drawn > lot[r]) {
          lot[r] = drawn;
          colours[r] = colour;
        }
      }
    }
    [this.low, this.high] = [low, high];
  }

  // a pixel to which an orbit comes back again and again is drawn higher than one: lines of closed orbits stay
  // lines beside clouds of chaos
  write(image, c, width) {
    const { count, lot, colour, opacity, low, high, bold, height } = this, most = opacity.length - 1;
    const reach = this.half[0] === 0 ? this.reach : 0;
    for (let r = low; r <= high; r++) {
      if (count[r] === 0) continue;
      const n = count[r] < most ? count[r] : most, word = ((colour[r] & 0xffffff) | (opacity[n] << 24)) >>> 0;
      image[r * width + c] = word;
      if (reach && count[r] >= bold) {
        for (let d = 1; d <= reach; d++) {
          if (r >= d && count[r - d] === 0) image[(r - d) * width + c] = word;
          if (r + d < height && count[r + d] === 0) image[(r + d) * width + c] = word;
        }
      }
    }
    if (low <= high) {
      count.fill(0, low, high + 1);
      lot.fill(0, low, high + 1);
    }
    [this.low, this.high] = [height, -1];
  }
}

/** Opacity [0, 255] by the number of points in a pixel, for a mean number of them. */
function opacities(density) {
  const one = Math.max(0.3, 0.85 / (1 + 0.5 * Math.log2(1 + density))), full = 2 + 12 * density;
  return Uint8Array.from({ length: 1024 }, (_, n) =>
    n === 0 ? 0 : Math.round(255 * Math.min(1, one + ((1 - one) * Math.log(n)) / Math.log(1 + full))));
}
