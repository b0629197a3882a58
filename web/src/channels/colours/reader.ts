/**
 * What a key opens in the colours of a model: bytes that survive other formats (docs/channels.md).
 * `keyss.channels.colours.reading` on the other side.
 */
import { sha256 } from '@noble/hashes/sha2.js';
import { ascii, joined } from '../../core/bytes.ts';
import { InputError, tooMuchLost } from '../../core/errors.ts';
import type { Gaussians } from '../../core/gaussians.ts';
import { namesakes } from '../../core/words.ts';
import { decrypted, type Derive, expand, SALT_BYTES } from '../../keys/keys.ts';
import { here } from '../../keys/pool.ts';
import { type Payload, type Reader, unpackPayload } from '../content.ts';
import { type Carriers, carriersOf, CELL, chosen, type Numbers, numbersOf, shifted } from './carriers.ts';
import { Fountain } from './fountain.ts';
import {
  bucketBytes, type Header, headerAgreement, IDLE, Index, kindOf, ownRows, packBits, readHeader,
  VIEWS,
} from './header.ts';
import { bitCounts, COLUMNS, dithers, rank, readBits, seedsOf, sum } from './lattice.ts';
import { saltsOf } from './salts.ts';

const ASSOCIATED = ascii('keyss/v1/colours');
const STATIC_SALT = sha256(ascii('keyss/v1/colours-static')).slice(0, SALT_BYTES);
// Shares of carriers that may hold something else: in ordinary files, in merged ones.
const CHANGED = [0.03, 0.5];
const ROUNDS = 60;
const MAX_RATE = 4; // data bits for each code bit
const CELLS_AROUND = [0, 1, -1, 2, -2, 3, -3, 4, -4]; // where a writer may have had its zero, in cells
const CELLS_SCALED = [0, 1, -1]; // in a model that was scaled
const ALIGNMENTS = 7; // of borders of cells
const BEST = 3; // of all these, that are looked at more closely
const REFINED = [[0.02, 0.004], [0.004, 0.001]]; // where it is looked for once a header is found

/** The colours of a model, prepared for any number of keys. */
export class ColoursReader implements Reader {
  private constructor(private readonly numbers: Numbers, readonly salts: readonly Uint8Array[]) {}

  static of(model: Gaussians): ColoursReader {
    const numbers = numbersOf(model);
    return new ColoursReader(numbers, saltsOf(numbers));
  }

  get derivations(): number {
    return 1 + this.salts.length;
  }

  /** What `key` opens, null for nothing. Raises InputError for damage. */
  async open(key: string, derive: Derive = here): Promise<Payload | null> {
    const masters = await Promise.all([STATIC_SALT, ...this.salts].map((salt) => derive(key, salt)));
    const fixed = expand(masters[0], 'colours/static', 32);
    const secrets = masters.slice(1).map((each) => expand(each, 'colours/header', 32));
    const check = expand(fixed, 'colours/check', 32);
    const promises: { offset: number; promise: number }[] = [];
    for (const [offset, index] of this.indices()) promises.push({ offset, promise: index.promise(secrets) });
    promises.sort((a, b) => b.promise - a.promise || b.offset - a.offset);
    const best = promises.slice(0, BEST).map(({ offset }) => ({ offset, index: new Index(carriersOf(this.numbers, offset)) }));
    const found = new Map<string, Header>();
    for (const { index } of best) {
      for (const [kind, view] of VIEWS) {
        const header = readHeader(secrets, check, index, kind, view);
        if (header !== null) found.set(header.bits.join(''), header);
      }
    }
    // An attempt makes a header up by chance, 2^-16, and the right one can be read where names are wrong.
    let [header, offset, most]: [Header | null, number, number] = [null, 0, -Infinity];
    for (const each of found.values()) {
      for (const place of best) {
        const agreement = headerAgreement(each, secrets, place.index);
        if (agreement > most) [header, offset, most] = [each, place.offset, agreement];
      }
    }
    if (header === null) return null;
    const carriers = this.refined(header, secrets, offset);
    const index = new Index(carriers);
    const taken = new Set(secrets.flatMap((each) => [...index.rows(each, kindOf(header))]));
    const free = chosen(carriers, Uint32Array.from({ length: carriers.count }, (_, row) => row).filter((row) => !taken.has(row)));
    for (const changed of CHANGED) {
      const data = await payload(header, fixed, free, changed, ROUNDS);
      if (data !== null) return unpackPayload(data);
    }
    throw tooMuchLost();
  }

  /** What the writer may have taken for a log scale of zero, and the carriers by their names then. */
  private *indices(): Generator<[number, Index]> {
    if (!this.numbers.count) return;
    const whole = Math.round(this.numbers.size / CELL) * CELL;
    for (let alignment = 0; alignment < ALIGNMENTS; alignment++) {
      const offset = whole + (alignment * CELL) / ALIGNMENTS;
      const carriers = carriersOf(this.numbers, offset);
      for (const cells of alignment ? CELLS_SCALED : CELLS_AROUND) {
        yield [offset + cells * CELL, new Index(shifted(carriers, cells))];
      }
    }
  }

  /** The carriers; where the model was scaled, under the names that agree best with the header. */
  private refined(header: Header, secrets: readonly Uint8Array[], around: number): Carriers {
    let offset = around;
    if (offset % CELL) {
      for (const [reach, step] of REFINED) {
        const start = offset - reach;
        let most = -Infinity;
        for (let at = 0; at <= Math.round((2 * reach) / step); at++) {
          const agreement = headerAgreement(header, secrets, new Index(carriersOf(this.numbers, start + at * step)));
          if (agreement > most) [most, offset] = [agreement, start + at * step];
        }
      }
    }
    return carriersOf(this.numbers, offset);
  }
}

/** What the header's data key decrypts, or null. */
async function payload(
  header: Header, fixed: Uint8Array, carriers: Carriers, changed: number, rounds: number,
): Promise<Uint8Array | null> {
  const own = chosen(carriers, ownRows(header, carriers));
  const [size, key] = [bucketBytes(header.bucket), expand(joined(fixed, header.fileKey), 'colours/data-key', 32)];
  const counts = bitCounts(own, header.level, header.depth);
  if (!own.count || 8 * size > MAX_RATE * COLUMNS * sum(counts)) return null;
  const garbage = Math.min(0.9, header.idle * IDLE + changed);
  const alike = namesakes(rank(header.partition, 'partition', own.names));
  const doubt = own.doubt.map((each, row) => 1 - ((1 - garbage) * (1 - each)) / alike[row]);
  const ratios = readBits(dithers(key, own.names), own, counts, doubt);
  const bits = new Fountain(8 * size).likeliest(seedsOf(rank(key, 'seeds', own.names), counts), ratios, rounds);
  try {
    return await decrypted(key, packBits(bits.subarray(0, 8 * size)), ASSOCIATED);
  } catch (error) {
    if (error instanceof InputError) return null;
    throw error;
  }
}
