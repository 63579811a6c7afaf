// Arrays as the server packs them (pipeline/explorer/data/arrays.py): one buffer, read without copying.

const TYPES = {
  float64: Float64Array, float32: Float32Array, int32: Int32Array, uint32: Uint32Array,
  int16: Int16Array, uint16: Uint16Array, int8: Int8Array, uint8: Uint8Array,
};

/**
 * Read a buffer of arrays.
 * @param {ArrayBuffer} buffer
 * @returns {{attrs: Object, arrays: Object<string, TypedArray>, shapes: Object<string, number[]>}}
 */
export function unpackArrays(buffer) {
  const begin = 4 + new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, begin - 4)));
  const arrays = {}, shapes = {};
  for (const [name, { dtype, shape, offset }] of Object.entries(header.arrays)) {
    const length = shape.reduce((a, b) => a * b, 1);
    arrays[name] = new TYPES[dtype](buffer, begin + offset, length);
    shapes[name] = shape;
  }
  return { attrs: header.attrs, arrays, shapes };
}
