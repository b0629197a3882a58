/** Reader of colours (docs/channels.md); counterpart of `keyss.channels.colours.colours_reader`. */
import { ascii } from '../../core/bytes.ts';
import { InputError, tooMuchLost } from '../../core/errors.ts';
import type { Gaussians } from '../../core/gaussians.ts';
import { decrypted, type Derive } from '../../keys/keys.ts';
import { here } from '../../keys/pool.ts';
import { type Payload, type Reader, unpackPayload } from '../content.ts';
import { type Carriers, carriersOf, chosen } from './carriers.ts';
import { Fountain } from './fountain.ts';
import { type Header, ownRows, packBits, readHeader, type Secrets, secretsOf, shiftOf, STATIC_SALT } from './header.ts';
import { bitCounts, COLUMNS, ONE, readBits, seedsOf } from './qim.ts';
import { saltsOf } from './salt_gaussians.ts';

const ASSOCIATED = ascii('keyss/v1/colours');
const CHANGED = 0.03; // share of carriers overwritten since
const MAX_RATE = 4; // data bits per code bit
const ALIGNMENTS = 4; // offsets of log scales tried

/** The colours of a model, prepared for any number of keys. */
export class ColoursReader implements Reader {
  private constructor(private readonly alignments: readonly Carriers[], readonly salts: readonly Uint8Array[]) {}

  static of(model: Gaussians): ColoursReader {
    const alignments = Array.from({ length: ALIGNMENTS }, (_, each) => carriersOf(model, each / ALIGNMENTS));
    return new ColoursReader(alignments, saltsOf(alignments[0]));
  }

  get derivations(): number {
    return 1 + this.salts.length;
  }

  /** The content that `key` opens, or null. Raises InputError for damage. */
  async open(key: string, derive: Derive = here): Promise<Payload | null> {
    const secrets = secretsOf(await Promise.all([STATIC_SALT, ...this.salts].map((salt) => derive(key, salt))));
    const headers = this.alignments.map((carriers) => readHeader(secrets, carriers));
    for (const [index, header] of headers.entries()) {
      if (header === null) continue;
      const carriers = this.alignments[index];
      for (const shift of header.level === ONE ? [0] : [0, shiftOf(header, carriers)]) {
        const data = await payload(header, secrets, carriers, shift);
        if (data !== null) return unpackPayload(data);
      }
    }
    if (headers.some((each) => each !== null)) throw tooMuchLost();
    return null;
  }
}

/** The payload decrypted by the header's key, or null. */
async function payload(header: Header, secrets: Secrets, carriers: Carriers, shift: number): Promise<Uint8Array | null> {
  const own = chosen(carriers, ownRows(header, secrets, carriers));
  const bits = bitCounts(own.impact.map((each) => each - shift), header.level);
  const sure: number[] = [];
  bits.forEach((count, row) => {
    const each = (header.occupancy * (1 - CHANGED) * (1 - own.errorProbability[row])) / own.idCounts[row];
    for (let bit = 0; bit < COLUMNS * count; bit++) sure.push(each);
  });
  if (8 * header.size > MAX_RATE * sure.length) return null;
  const hints = readBits(header.key, own, bits).map((hint, at) => hint * sure[at]);
  const found = new Fountain(8 * header.size).decode(seedsOf(header.key, 'seeds', own, bits), hints);
  try {
    return await decrypted(header.key, packBits(found), ASSOCIATED);
  } catch (error) {
    if (error instanceof InputError) return null;
    throw error;
  }
}
