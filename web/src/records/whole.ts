/** A model as one string of bytes; `keyss.methods.records.whole` on the other side. */
import { unpackedZstd, viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians } from '../core/gaussians.ts';
import { Codec, type Layout, putColours } from './codec.ts';

const ALWAYS = 1 << 16; // Gaussians, whatever announces them
const MIN_BYTES = 2; // of each Gaussian in larger models
const HEAD_BYTES = 9; // Gaussians (4), SH degree (1), step of harmonics (4)
const PER_OCTAVE = 0.5 / Math.LN2; // half octaves of the step
const FINER = 6; // half octaves by which a step is finer or coarser, at most
const [FIRST_POSITION, AFTER_POSITIONS] = [3, 6]; // among the parts of a layout

/**
 * The model, read from a model of `carriers` Gaussians. Raises InputError for damage. Above 2^16 Gaussians, each takes
 * at least 2 bytes of `data`, and there are no more than `carriers`.
 */
export function decodeWhole(data: Uint8Array, carriers: number): Gaussians {
  if (data.length < HEAD_BYTES) throw damaged();
  const view = viewOf(data);
  const [count, shDegree, step] = [view.getUint32(0, true), data[4], view.getFloat32(5, true)];
  const codec = Codec.unpack(data.subarray(HEAD_BYTES));
  const largest = Math.max(ALWAYS, Math.min(Math.floor(data.length / MIN_BYTES), carriers));
  const possible = count > 0 && count <= largest && shDegree <= 3 && step > 0 && step < 1;
  if (!possible || codec.shDegree !== 0) throw damaged();
  const { layout } = codec;
  const own = layout.reduce((sum, [columns, bits]) => sum + columns * Math.ceil(bits / 8), 0);
  const harmonics = coefficients(shDegree) - 1;
  const packed = data.subarray(HEAD_BYTES + Codec.packedSize(0));
  const planes = unpackedZstd(packed, count * (own + 3 * harmonics));
  const found = emptyGaussians(count, shDegree);
  const columns = columnsOf(planes, layout, count);
  const codes = new Uint32Array(columns.length);
  for (let row = 0; row < count; row++) {
    for (let column = 0; column < codes.length; column++) codes[column] = columns[column][row];
    codec.put(found, row, codes);
  }
  putHarmonics(found, new Int8Array(planes.buffer, own * count), step);
  return found;
}

/** Codes [N] of each column: planes hold the lowest bytes of a column, then the higher ones. */
function columnsOf(planes: Uint8Array, layout: Layout, count: number): Uint32Array[] {
  const found: Uint32Array[] = [];
  let at = 0;
  layout.forEach(([columns, bits], index) => {
    const mask = 2 ** bits - 1;
    for (let column = 0; column < columns; column++) {
      const codes = new Uint32Array(count);
      for (let shift = 0; shift < bits; shift += 8) {
        for (let row = 0; row < count; row++) codes[row] |= planes[at++] << shift;
      }
      if (index >= FIRST_POSITION && index < AFTER_POSITIONS) { // the differences from one to the next
        for (let row = 1; row < count; row++) codes[row] += codes[row - 1];
      }
      for (let row = 0; row < count; row++) codes[row] &= mask;
      found.push(codes);
    }
  });
  return found;
}

/** `codes` [K - 1, 3, N]: of each coefficient above degree 0 brightness and two differences, equal steps together. */
function putHarmonics(to: Gaussians, codes: Int8Array, step: number): void {
  const { count, shDegree, sh } = to;
  const k = coefficients(shDegree);
  const finer = finerSteps(to);
  const rows = Array.from(finer.keys()).sort((a, b) => finer[a] - finer[b]); // equal ones stay in their order
  for (let each = 1; each < k; each++) {
    const [a, b, c] = [0, 1, 2].map((value) => codes.subarray(count * (3 * (each - 1) + value)));
    rows.forEach((row, at) => {
      const own = step * (finer[row] % 2 ? Math.SQRT2 : 1) * 2 ** -Math.floor((finer[row] + 1) / 2);
      putColours(sh, 3 * (k * row + each), a[at] * own, b[at] * own, c[at] * own);
    });
  }
}

/** [N] half octaves by which the steps of each Gaussian are finer than those of the middle one, by area and opacity. */
function finerSteps({ count, logScales, opacityLogits }: Gaussians): Int8Array {
  const seen = Float64Array.from({ length: count }, (_, row) => {
    const [, second, third] = logScales.slice(3 * row, 3 * row + 3).sort();
    return third + second + 2 * Math.min(opacityLogits[row], 0);
  });
  const middle = seen.slice().sort()[(count - 1) >> 1];
  return Int8Array.from(seen, (each) => {
    const found = Math.floor((each - middle) * PER_OCTAVE + 0.5);
    return Math.min(Math.max(found, -FINER), FINER);
  });
}
