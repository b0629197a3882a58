/** Decodes records to Gaussians; see docs/byte-layout.md, "Records of Gaussians". */
import { halfFloat, viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians } from '../core/gaussians.ts';
import { fromSmallestThree } from '../files/coded.ts';

const BANDS = [1, 3, 5, 7]; // coefficients of each degree
const CHROMA_FEWER = 2; // bits less for colour differences
const MAX_BITS = 24;
const TABLE_BYTES = 8;
const LINE_BYTES = 12;
const MAX_VALUE = 1e30;
const [BRIGHTNESS, RED_GREEN, BLUE] = [1 / Math.sqrt(3), 1 / Math.sqrt(2), 1 / Math.sqrt(6)];

/** Quantiser of values around a centre to codes 0 to 2^bits - 1, uniform or by sinh. */
class Line {
  constructor(readonly centre: number, readonly spread: number, readonly reach: number) {
    const bounded =
      Math.abs(centre) < MAX_VALUE && spread >= 0 && spread < MAX_VALUE && reach > 0 && reach < MAX_VALUE;
    const steep = spread > 0 && (reach > 60 || spread * Math.sinh(reach) > MAX_VALUE);
    if (!bounded || steep) throw damaged();
  }

  value(code: number, bits: number): number {
    const position = (code * (2 / (2 ** bits - 1)) - 1) * this.reach;
    return (this.spread > 0 ? Math.sinh(position) * this.spread : position) + this.centre;
  }
}

const QUAT_LINE = new Line(0, 0, Math.sqrt(0.5));

/** The Gaussians of records of any bytes. Raises InputError for a header that is damaged or of other records. */
export function decodeRecords(header: Uint8Array, records: readonly Uint8Array[]): Gaussians {
  const [bits, lines, far] = parsed(header);
  const [means, logScales, quats, opacity, ...colours] = bits;
  const geometry = 1 + 2 + 3 * (quats + means + logScales) + opacity;
  const size = colours.reduce((sum, each, band) => sum + BANDS[band] * (3 * each - 2 * CHROMA_FEWER), geometry);
  if (records[0].length !== Math.ceil(size / 8)) throw damaged();
  const found = emptyGaussians(records.length, colours.length - 1);
  records.forEach((record, row) => {
    const next = codesOf(record);
    const own = next(1) ? far : lines;
    const decoded = (line: Line, count: number): number => line.value(next(count), count);
    found.quats.set(wholeQuat(next(2), [0, 1, 2].map(() => decoded(QUAT_LINE, quats))), 4 * row);
    for (let axis = 0; axis < 3; axis++) found.means[3 * row + axis] = decoded(own[axis], means);
    for (let axis = 0; axis < 3; axis++) found.logScales[3 * row + axis] = decoded(own[3], logScales);
    found.opacityLogits[row] = decoded(own[4], opacity);
    let at = 3 * row * coefficients(found.shDegree);
    colours.forEach((each, band) => {
      const [bright, different] = [own[5 + 2 * band], own[6 + 2 * band]];
      for (const a of Array.from({ length: BANDS[band] }, () => decoded(bright, each))) {
        putColours(found.sh, at, a, decoded(different, each - CHROMA_FEWER), decoded(different, each - CHROMA_FEWER));
        at += 3;
      }
    });
  });
  return found;
}

/** Bits of positions, log scales, quaternions, opacity, then of each degree; lines, and those for outliers. */
function parsed(header: Uint8Array): [number[], Line[], Line[]] {
  if (header.length < TABLE_BYTES) throw damaged();
  let count = TABLE_BYTES;
  while (count > 0 && header[count - 1] === 0) count--;
  const bits = [...header.subarray(0, count)];
  const impossible = bits.length < 5 || bits.some((each) => each < 1 || each > MAX_BITS);
  if (impossible || Math.min(...bits.slice(4)) <= CHROMA_FEWER) throw damaged();
  const size = TABLE_BYTES + LINE_BYTES * (2 * bits.length - 3);
  if (header.length < size) throw damaged();
  const view = viewOf(header);
  const [lines, far]: Line[][] = [[], []];
  for (let at = TABLE_BYTES; at < size; at += LINE_BYTES) {
    const [centre, spread] = [view.getFloat32(at, true), view.getFloat32(at + 4, true)];
    lines.push(new Line(centre, spread, halfFloat(view.getUint16(at + 8, true))));
    far.push(new Line(centre, spread, halfFloat(view.getUint16(at + 10, true))));
  }
  return [bits, lines, far];
}

/** A function that returns the next code of so many bits, the most significant bit first. */
function codesOf(record: Uint8Array): (bits: number) => number {
  let bit = 0;
  return (bits) => {
    let code = 0;
    for (let left = bits; left > 0; left--, bit++) code = code * 2 + ((record[bit >> 3] >> (7 - (bit & 7))) & 1);
    return code;
  };
}

/** Writes red, green and blue from brightness and two colour differences. */
export function putColours(to: Float32Array, at: number, brightness: number, first: number, second: number): void {
  to[at] = brightness * BRIGHTNESS + first * RED_GREEN + second * BLUE;
  to[at + 1] = brightness * BRIGHTNESS - first * RED_GREEN + second * BLUE;
  to[at + 2] = brightness * BRIGHTNESS - 2 * second * BLUE;
}

function wholeQuat(leftOut: number, three: number[]): number[] {
  const quat = fromSmallestThree(leftOut, three);
  const length = Math.max(0.5, Math.sqrt(quat.reduce((sum, each) => sum + each * each, 0)));
  return quat.map((each) => each / length);
}
