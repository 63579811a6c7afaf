// In place of codecs that exported cubes do not use: they are WebAssembly, larger than the rest of the page.

export default class OtherCodec {
  static fromConfig() {
    throw new Error("a chunk is compressed by something other than gzip; magpend export writes gzip alone");
  }
}
