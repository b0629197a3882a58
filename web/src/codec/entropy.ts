/** Adaptive binary range decoder of integers; counterpart of `keyss.methods.codec.entropy`. */
import { damaged } from '../core/errors.ts';

const MOST = 31; // bits of a difference
const CONTEXTS = 48; // expected numbers of bits, in thirds; one more for the first bit
const [FAST, SLOW] = [4, 7]; // adaptation shifts
const FLAT = 12; // bits of equal probability at once

/** Decodes bits by adaptive probabilities of 0: the mean of a fast and a slow estimate, in 65,536ths. */
class Decoder {
  private at = 0;
  private place = 0;
  private range = 0xffffffff;
  private readonly fast: Uint16Array;
  private readonly slow: Uint16Array;

  constructor(private readonly data: Uint8Array, chances: number) {
    this.fast = new Uint16Array(chances).fill(1 << 15);
    this.slow = new Uint16Array(chances).fill(1 << 15);
    for (let byte = 0; byte < 4; byte++) this.next();
  }

  get exhausted(): boolean {
    return this.at === this.data.length;
  }

  get beyond(): boolean {
    return this.at >= this.data.length + 4;
  }

  /** A bit by the adaptive probability at an index. */
  bit(chance: number): number {
    const [fast, slow] = [this.fast[chance], this.slow[chance]];
    const bound = (this.range >>> 12) * ((fast + slow) >> 5);
    if (this.place < bound) {
      this.range = bound;
      this.fast[chance] = fast + ((65536 - fast) >> FAST);
      this.slow[chance] = slow + ((65536 - slow) >> SLOW);
      this.normalise();
      return 0;
    }
    this.place -= bound;
    this.range -= bound;
    this.fast[chance] = fast - (fast >> FAST);
    this.slow[chance] = slow - (slow >> SLOW);
    this.normalise();
    return 1;
  }

  /** Up to FLAT bits of probability 1/2. */
  bits(count: number): number {
    this.range >>>= count;
    const found = Math.min(Math.floor(this.place / this.range), (1 << count) - 1);
    this.place -= found * this.range;
    this.normalise();
    return found;
  }

  private normalise(): void {
    for (; this.range < 2 ** 24; this.range *= 256) this.next();
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
  const decoder = new Decoder(data, ofGroup * (Math.max(...groups) + 1));
  const table = shares.map(() => new Int32Array(count));
  const [before, sizes] = [new Int32Array(shares.length), new Int32Array(shares.length)];
  for (let row = 0; row < count && !decoder.beyond; row++) {
    let lately = 0;
    for (let column = 0; column < shares.length; column++) {
      const first = groups[column] * ofGroup;
      const context = Math.min(CONTEXTS - 1, (sizes[column] + lately) >> 2);
      const own = first + (MOST + 1) * context;
      let size = Math.floor(context / 3);
      if (decoder.bit(own + size)) {
        size++;
        while (size < MOST && decoder.bit(own + size)) size++;
      } else while (size > 0 && !decoder.bit(own + size - 1)) size--;
      let difference = 0;
      if (size > 0) {
        let value = size > 1 ? 2 + decoder.bit(first + (MOST + 1) * CONTEXTS + size) : 1;
        let left = size - 2;
        for (; left > FLAT - 1; left -= FLAT) value = value * 2 ** FLAT + decoder.bits(FLAT);
        const last = decoder.bits(1 + Math.max(0, left)); // the other bits, and the sign
        value = value * 2 ** Math.max(0, left) + (last >> 1);
        difference = last & 1 ? -value : value;
      }
      before[column] = Math.floor((shares[column] * before[column]) / 8) + difference;
      table[column][row] = before[column];
      sizes[column] += (4 * size - sizes[column] + 1) >> 1;
      lately += (8 * size - lately + 2) >> 2;
    }
  }
  if (!decoder.exhausted) throw damaged();
  return table;
}
