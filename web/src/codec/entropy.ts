/** Adaptive binary range decoder of integers; counterpart of `keyss.methods.codec.entropy`. */
import { damaged } from '../core/errors.ts';

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
export function decodeTable(data: Uint8Array, count: number, shares: number[], groups: number[]): Int32Array[] {
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
