// What pack.py has put together: a document, and the arrays that it names.

const ARRAYS = { f4: Float32Array, f8: Float64Array, i4: Int32Array, i2: Int16Array, u1: Uint8Array };
const ALIGNED = 8; // bytes, as in pack.py

/** Return the document in `content` with its arrays in their places, each with its `shape`. */
function unpackDocument(content) {
  const { buffer, byteOffset } = content.byteOffset % ALIGNED ? content.slice() : content;
  const length = new DataView(buffer, byteOffset).getUint32(0, true), behind = byteOffset + ALIGNED + length;
  const header = new TextDecoder().decode(new Uint8Array(buffer, byteOffset + ALIGNED, length));
  return JSON.parse(header, (_, value) => {
    if (!value || !ARRAYS[value.kind] || !Array.isArray(value.shape)) return value;
    const count = value.shape.reduce((all, n) => all * n, 1);
    return Object.assign(new ARRAYS[value.kind](buffer, behind + value.at, count), { shape: value.shape });
  });
}
