/**
 * Raw LZMA2 streams of a known size: what Python's `lzma` writes as FORMAT_RAW with FILTER_LZMA2.
 *
 * By the "LZMA specification" (Pavlov 2015) and the description of LZMA2's chunks in the Linux kernel's
 * lib/xz/xz_dec_lzma2.c. The libraries for browsers read .xz or .lzma files, whose headers these streams do not have.
 */
import { viewOf } from './bytes.ts';
import { InputError } from './errors.ts';

const DICTIONARY = 1 << 22; // bytes: no match is further away
const HALF = 1024; // a probability of 11 bits
const STATES = 12;
const [LITERAL_STATES, FIRST_SHORT_REP] = [7, 9];
const [LEAST_MATCH, LENGTH_CLASSES] = [2, 4];
const [LOW_LENGTHS, HIGH_LENGTHS] = [8, 256];
const FIRST_DIRECT_SLOT = 14; // of distances of which some bits have no probabilities

/** What a stream becomes, `size` bytes. Raises InputError for damage and for any other size. */
export function unpackedLzma2(stream: Uint8Array, size: number): Uint8Array {
  if (announced(stream) !== size) throw damagedStream();
  const decoder = new Decoder(stream, new Uint8Array(size));
  for (let at = 0, first = true; stream[at] !== 0; first = false) {
    const control = stream[at];
    const view = viewOf(stream);
    if (first && control !== 1 && control < 0xe0) throw damagedStream();
    if (control < 0x80) {
      const length = view.getUint16(at + 1) + 1;
      decoder.copy(at + 3, length, control === 1);
      at += 3 + length;
      continue;
    }
    const reset = (control >> 5) & 3; // 1: probabilities; 2: and new parameters; 3: and the dictionary
    if (reset >= 2) decoder.parameters(stream[at + 5]);
    const start = at + (reset >= 2 ? 6 : 5);
    const packed = view.getUint16(at + 3) + 1;
    decoder.chunk(start, start + packed, ((control & 31) << 16) + view.getUint16(at + 1) + 1, reset);
    at = start + packed;
  }
  return decoder.out;
}

/** Bytes that the chunks of a stream become together, by their headers. Raises InputError. */
function announced(stream: Uint8Array): number {
  const view = viewOf(stream);
  let [at, total] = [0, 0];
  while (stream[at] !== 0) {
    const control = stream[at];
    if (at + 5 > stream.length || (control > 2 && control < 0x80)) throw damagedStream();
    if (control < 0x80) {
      const length = view.getUint16(at + 1) + 1;
      [at, total] = [at + 3 + length, total + length];
    } else {
      total += ((control & 31) << 16) + view.getUint16(at + 1) + 1;
      at += (control >= 0xc0 ? 6 : 5) + view.getUint16(at + 3) + 1;
    }
  }
  if (at + 1 !== stream.length) throw damagedStream();
  return total;
}

/** One range coder, one set of probabilities, one dictionary, which is what was written. */
class Decoder {
  private at = 0; // byte of the stream to be read next
  private end = 0;
  private range = 0;
  private code = 0;
  private to = 0; // byte of `out` to be written next
  private dictionary = 0; // where it begins
  private literalContext = 0; // bits
  private literalPosition = 0; // mask
  private position = 0; // mask
  private state = 0;
  private readonly reps = new Int32Array(4); // the last distances, less one
  private literals = new Uint16Array(0);
  private readonly others = new Uint16Array(2048);
  private readonly isMatch: number;
  private readonly isRep: number;
  private readonly isRep0: number;
  private readonly isRep1: number;
  private readonly isRep2: number;
  private readonly isLongRep: number;
  private readonly slots: number;
  private readonly distances: number;
  private readonly aligned: number;
  private readonly matchLengths: number;
  private readonly repLengths: number;

  constructor(private readonly stream: Uint8Array, readonly out: Uint8Array) {
    let next = 0;
    const room = (count: number): number => (next += count) - count;
    [this.isMatch, this.isLongRep] = [room(STATES << 4), room(STATES << 4)];
    [this.isRep, this.isRep0, this.isRep1, this.isRep2] = [room(STATES), room(STATES), room(STATES), room(STATES)];
    [this.slots, this.distances, this.aligned] = [room(LENGTH_CLASSES << 6), room(128), room(16)];
    const lengths = 2 + 2 * (LOW_LENGTHS << 4) + HIGH_LENGTHS;
    [this.matchLengths, this.repLengths] = [room(lengths), room(lengths)];
  }

  /** Of how many bits of what surroundings probabilities depend. */
  parameters(packed: number): void {
    const [context, rest] = [packed % 9, Math.floor(packed / 9)];
    const position = rest % 5;
    if (rest >= 25 || context + position > 4) throw damagedStream();
    this.literalContext = context;
    this.literalPosition = (1 << position) - 1;
    this.position = (1 << Math.floor(rest / 5)) - 1;
    this.literals = new Uint16Array(0x300 << (context + position));
  }

  /** A chunk that is not packed. */
  copy(from: number, length: number, resets: boolean): void {
    if (resets) {
      this.dictionary = this.to;
      this.literals = new Uint16Array(0); // parameters have to come again
    }
    this.out.set(this.stream.subarray(from, from + length), this.to);
    this.to += length;
  }

  /** A chunk that becomes `size` bytes; `reset`: 1 to 3 as its header has it. */
  chunk(start: number, end: number, size: number, reset: number): void {
    if (reset === 3) this.dictionary = this.to;
    if (reset >= 1) {
      this.literals.fill(HALF);
      this.others.fill(HALF);
      this.reps.fill(0);
      this.state = 0;
    }
    if (!this.literals.length || end - start < 5 || this.stream[start] !== 0) throw damagedStream();
    this.code = viewOf(this.stream).getUint32(start + 1);
    [this.range, this.at, this.end] = [0xffffffff, start + 5, end];
    const last = this.to + size;
    while (this.to < last) this.symbol(last);
    this.normalise();
    if (this.at !== end || this.code !== 0) throw damagedStream();
  }

  private symbol(last: number): void {
    const near = (this.to - this.dictionary) & this.position;
    if (!this.bit(this.others, this.isMatch + (this.state << 4) + near)) return this.literal();
    let length: number;
    if (this.bit(this.others, this.isRep + this.state)) {
      if (!this.bit(this.others, this.isRep0 + this.state)) {
        if (!this.bit(this.others, this.isLongRep + (this.state << 4) + near)) {
          this.state = this.state < LITERAL_STATES ? FIRST_SHORT_REP : 11;
          return this.repeat(1, last);
        }
      } else this.recall();
      length = this.length(this.repLengths, near);
      this.state = this.state < LITERAL_STATES ? 8 : 11;
    } else {
      this.reps.copyWithin(1, 0, 3);
      length = this.length(this.matchLengths, near);
      this.state = this.state < LITERAL_STATES ? 7 : 10;
      this.reps[0] = this.distance(length);
    }
    this.repeat(length, last);
  }

  private literal(): void {
    const at = this.to - this.dictionary;
    const before = at ? this.out[this.to - 1] : 0;
    const context = ((at & this.literalPosition) << this.literalContext) + (before >> (8 - this.literalContext));
    const table = 0x300 * context;
    let symbol = 1;
    if (this.state >= LITERAL_STATES) {
      let matched = this.out[this.to - this.reps[0] - 1];
      while (symbol < 0x100) {
        const expected = (matched >> 7) & 1;
        matched <<= 1;
        const bit = this.bit(this.literals, table + ((1 + expected) << 8) + symbol);
        symbol = (symbol << 1) | bit;
        if (bit !== expected) break;
      }
    }
    while (symbol < 0x100) symbol = (symbol << 1) | this.bit(this.literals, table + symbol);
    this.out[this.to++] = symbol;
    this.state = this.state < 4 ? 0 : this.state < 10 ? this.state - 3 : this.state - 6;
  }

  /** Makes the second, third or fourth of the last distances the first. */
  private recall(): void {
    const { reps, others } = this;
    const index = !this.bit(others, this.isRep1 + this.state) ? 1 : 2 + this.bit(others, this.isRep2 + this.state);
    const found = reps[index];
    reps.copyWithin(1, 0, index);
    reps[0] = found;
  }

  private repeat(length: number, last: number): void {
    const distance = this.reps[0] + 1;
    const furthest = Math.min(this.to - this.dictionary, DICTIONARY);
    if (distance < 1 || distance > furthest || this.to + length > last) throw damagedStream();
    for (const end = this.to + length; this.to < end; this.to++) this.out[this.to] = this.out[this.to - distance];
  }

  private length(table: number, near: number): number {
    const [low, middle] = [table + 2, table + 2 + (LOW_LENGTHS << 4)];
    if (!this.bit(this.others, table)) return LEAST_MATCH + this.tree(low + (near << 3), 3);
    if (!this.bit(this.others, table + 1)) return LEAST_MATCH + LOW_LENGTHS + this.tree(middle + (near << 3), 3);
    return LEAST_MATCH + 2 * LOW_LENGTHS + this.tree(middle + (LOW_LENGTHS << 4), 8);
  }

  /** A distance less one; -1 for one that marks an end, which these streams do not have. */
  private distance(length: number): number {
    const slot = this.tree(this.slots + (Math.min(length - LEAST_MATCH, LENGTH_CLASSES - 1) << 6), 6);
    if (slot < 4) return slot;
    const bits = (slot >> 1) - 1;
    const start = (2 | (slot & 1)) << bits;
    if (slot < FIRST_DIRECT_SLOT) return start + this.reversed(this.distances + start - slot, bits);
    return (start + (this.direct(bits - 4) << 4) + this.reversed(this.aligned, 4)) | 0;
  }

  private tree(table: number, bits: number): number {
    let found = 1;
    for (let left = bits; left > 0; left--) found = (found << 1) | this.bit(this.others, table + found);
    return found - (1 << bits);
  }

  private reversed(table: number, bits: number): number {
    let [found, node] = [0, 1];
    for (let index = 0; index < bits; index++) {
      const bit = this.bit(this.others, table + node);
      node = (node << 1) | bit;
      found |= bit << index;
    }
    return found;
  }

  private direct(bits: number): number {
    let found = 0;
    for (let left = bits; left > 0; left--) {
      this.normalise();
      this.range = this.range >>> 1;
      const bit = this.code >= this.range ? 1 : 0;
      if (bit) this.code -= this.range;
      found = (found << 1) | bit;
    }
    return found;
  }

  private bit(table: Uint16Array, index: number): number {
    this.normalise();
    const probability = table[index];
    const bound = (this.range >>> 11) * probability;
    if (this.code < bound) {
      this.range = bound;
      table[index] = probability + ((2048 - probability) >> 5);
      return 0;
    }
    this.range -= bound;
    this.code -= bound;
    table[index] = probability - (probability >> 5);
    return 1;
  }

  private normalise(): void {
    if (this.range >= 0x1000000) return;
    if (this.at >= this.end) throw damagedStream();
    this.range = (this.range << 8) >>> 0;
    this.code = ((this.code << 8) | this.stream[this.at++]) >>> 0;
  }
}

function damagedStream(): InputError {
  return new InputError('The compressed data are damaged.');
}
