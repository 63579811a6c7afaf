// What both kinds of copies share: objects of data by name, packed as pipeline/explorer/data/arrays.py does.

import { unpackArrays } from "./arrays.js";

const TYPES = { float64: Float64Array, float32: Float32Array, int32: Int32Array, uint32: Uint32Array, int16: Int16Array, uint16: Uint16Array };

/** Decompress gzip. */
export async function gunzip(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

/** Put the bytes of numbers together again: they lie apart, all first bytes before all second ones. */
function joined(planes, dtype, length) {
  const Type = TYPES[dtype], size = Type.BYTES_PER_ELEMENT, bytes = new Uint8Array(length * size);
  for (let byte = 0; byte < size; byte++) {
    for (let i = 0, from = byte * length, to = byte; i < length; i++, from++, to += size) bytes[to] = planes[from];
  }
  return new Type(bytes.buffer);
}

/**
 * Read an object of arrays.
 * @param {ArrayBuffer} buffer as `pack_zipped` of pipeline/explorer/data/arrays.py has made it, decompressed
 * @returns {{attrs: Object, arrays: Object<string, TypedArray>, shapes: Object<string, number[]>}}
 */
export function unpackData(buffer) {
  const { attrs: { apart, ...attrs }, arrays, shapes } = unpackArrays(buffer);
  for (const [name, { dtype, shape }] of Object.entries(apart)) {
    arrays[name] = joined(arrays[name], dtype, shape.reduce((a, b) => a * b, 1));
    shapes[name] = shape;
  }
  return { attrs, arrays, shapes };
}

/** Read an object of JSON. */
export function parseData(buffer) {
  return JSON.parse(new TextDecoder().decode(buffer));
}

/** Name of an answer for one place of the axes, but for the horizontal one if `x` is given. */
export function placeKey(axes, at, x = null) {
  const places = axes.filter((axis) => axis.name !== x).map((axis) => `${axis.name}=${at?.[axis.name] ?? 0}`);
  return [...(x === null ? [] : [`x=${x}`]), ...places].join("&");
}
