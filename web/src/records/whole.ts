/** Decodes a model from one string of bytes; counterpart of `keyss.methods.records.whole` and `entropy`. */
import { viewOf } from '../core/bytes.ts';
import { damaged } from '../core/errors.ts';
import { coefficients, emptyGaussians, type Gaussians } from '../core/gaussians.ts';
import { putColours } from './codec.ts';

const ALWAYS = 1 << 16; // Gaussians allowed in any payload
const MIN_BYTES = 2; // per Gaussian in larger models
const HEAD_BYTES = 49; // Gaussians (4), SH degree (1), centres (20), steps (24)
const [MAX_CENTRE, MAX_STEP] = [1e30, 1e6];
const DIFFERENCE = 1.5; // step of constant colour differences relative to brightness
const PER_OCTAVE = 0.5 / Math.LN2; // half octaves of the step
const FINER = 6; // half octaves: maximum change of a step
const LEAST_W = 1 / 16; // minimum of w squared
// For x, y, z, log scales, opacity, colours and quaternion; harmonics have two more groups and no shares.
const [SHARES, GROUPS] = [[8, 8, 8, 2, 2, 2, 2, 6, 6, 6, 0, 0, 0], [0, 0, 0, 1, 1, 1, 2, 3, 4, 4, 5, 5, 5]];

/**
 * The model in a payload that a model of `carriers` Gaussians holds. Raises InputError for damage, and for more than
 * 2^16 Gaussians if they exceed `carriers` or take less than 2 bytes each.
 */
export function decodeWhole(data: Uint8Array, carriers: number): Gaussians {
  if (data.length < HEAD_BYTES) throw damaged();
  const view = viewOf(data);
  const [count, shDegree] = [view.getUint32(0, true), data[4]];
  const numbers = Array.from({ length: 11 }, (_, at) => view.getFloat32(5 + 4 * at, true));
  const [centres, steps] = [numbers.slice(0, 5), numbers.slice(5)];
  const largest = Math.max(ALWAYS, Math.min(Math.floor(data.length / MIN_BYTES), carriers));
  const centred = centres.every((each) => Math.abs(each) < MAX_CENTRE);
  const bounded = centred && steps.every((each) => each > 0 && each <= MAX_STEP);
  if (!(count > 0 && count <= largest && shDegree <= 3 && bounded)) throw damaged();
  const k = coefficients(shDegree);
  const [shares, groups] = [[...SHARES], [...GROUPS]];
  for (let each = 1; each < k; each++) {
    shares.push(0, 0, 0);
    groups.push(6, 7, 7);
  }
  const table = decodeTable(data.subarray(HEAD_BYTES), count, shares, groups);
  const found = emptyGaussians(count, shDegree);
  const [means, scales, opacity, colours, quats, harmonics] = steps;
  for (let row = 0; row < count; row++) {
    for (let axis = 0; axis < 3; axis++) {
      found.means[3 * row + axis] = table[axis][row] * means + centres[axis];
      found.logScales[3 * row + axis] = table[3 + axis][row] * scales + centres[3];
    }
    found.opacityLogits[row] = table[6][row] * opacity + centres[4];
  }
  finerSteps(found).forEach((finer, row) => {
    const scale = (step: number): number => step * (finer % 2 ? Math.SQRT2 : 1) * 2 ** -Math.floor((finer + 1) / 2);
    const [x, y, z] = [10, 11, 12].map((column) => table[column][row] * scale(quats));
    found.quats.set([Math.sqrt(Math.max(1 - (x * x + y * y + z * z), LEAST_W)), x, y, z], 4 * row);
    const own = scale(harmonics);
    for (let each = 0; each < k; each++) {
      const first = each ? 10 + 3 * each : 7;
      const [bright, different] = each ? [own, own] : [colours, colours * DIFFERENCE];
      const [a, b, c] = [table[first][row] * bright, table[first + 1][row] * different, table[first + 2][row] * different];
      putColours(found.sh, 3 * (k * row + each), a, b, c);
    }
  });
  return found;
}

/** [N] half octaves by which a Gaussian's steps are finer than the median one's, by area and opacity. */
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

const MOST = 31; // bits of a difference
const CONTEXTS = 16; // for the number of bits; one more for the first bit
const [FAST, SLOW] = [4, 7]; // adaptation shifts

/** Decodes bits by adaptive probabilities of 0: the mean of a fast and a slow estimate, in 65,536ths. */
class Decoder {
  private at = 0;
  private place = 0;
  private range = 0xffffffff;

  constructor(private readonly data: Uint8Array, private readonly chances: Uint16Array) {
    for (let byte = 0; byte < 4; byte++) this.next();
  }

  get exhausted(): boolean {
    return this.at === this.data.length;
  }

  get beyond(): boolean {
    return this.at > this.data.length + 4;
  }

  /** A bit of probability 1/2. */
  bit(): number {
    return this.within(this.range >>> 1);
  }

  /** A bit by the adaptive probability at an index. */
  likelyBit(chance: number): number {
    const { chances } = this;
    const [fast, slow] = [2 * chance, 2 * chance + 1];
    const bit = this.within((this.range >>> 12) * ((chances[fast] + chances[slow]) >> 5));
    chances[fast] += bit ? -(chances[fast] >> FAST) : (65536 - chances[fast]) >> FAST;
    chances[slow] += bit ? -(chances[slow] >> SLOW) : (65536 - chances[slow]) >> SLOW;
    return bit;
  }

  private within(bound: number): number {
    const bit = this.place < bound ? 0 : 1;
    if (bit) this.place -= bound;
    this.range = bit ? this.range - bound : bound;
    for (; this.range < 2 ** 24; this.range *= 256) this.next();
    return bit;
  }

  private next(): void {
    this.place = ((this.place << 8) | (this.data[this.at++] ?? 0)) >>> 0;
  }
}

/**
 * [columns][count] integers. `shares`: predictor weight of the previous row, in eighths, per column; columns of a group
 * share probabilities. Raises InputError for too few or too many bytes.
 */
function decodeTable(data: Uint8Array, count: number, shares: number[], groups: number[]): Int32Array[] {
  const ofGroup = (CONTEXTS + 1) * (MOST + 1);
  const decoder = new Decoder(data, new Uint16Array(2 * ofGroup * (Math.max(...groups) + 1)).fill(1 << 15));
  const table = shares.map(() => new Int32Array(count));
  const sizes = new Int32Array(shares.length);
  for (let row = 0; row < count && !decoder.beyond; row++) {
    let lately = 0;
    for (let column = 0; column < shares.length; column++) {
      const first = groups[column] * ofGroup;
      const own = first + (MOST + 1) * Math.min(CONTEXTS - 1, (sizes[column] + lately) >> 2);
      let size = 0;
      while (size < MOST && decoder.likelyBit(own + size)) size++;
      const negative = size > 0 && decoder.bit();
      let value = size > 1 ? 2 + decoder.likelyBit(first + (MOST + 1) * CONTEXTS + size) : size;
      for (let more = size - 2; more > 0; more--) value = 2 * value + decoder.bit();
      const before = row ? table[column][row - 1] : 0;
      table[column][row] = Math.floor((shares[column] * before) / 8) + (negative ? -value : value);
      sizes[column] += (4 * size - sizes[column] + 1) >> 1;
      lately += (8 * size - lately + 2) >> 2;
    }
  }
  if (!decoder.exhausted) throw damaged();
  return table;
}
