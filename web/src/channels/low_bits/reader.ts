/**
 * What a key opens in the low bits of a model.
 *
 * A key that opens nothing makes the same passes over all cells as one that opens a secret, and all salts are always
 * tried, so that how long it takes tells next to nothing.
 */
import { ascii, bytesKey, rowsOf } from '../../core/bytes.ts';
import { damaged, tooMuchLost } from '../../core/errors.ts';
import { type Gaussians, selected } from '../../core/gaussians.ts';
import { decrypted, type Derive, expand } from '../../keys/keys.ts';
import { here } from '../../keys/pool.ts';
import type { Content, Reader } from '../content.ts';
import { decoded } from '../reed_solomon.ts';
import { fieldsOf, IDENTITY_BYTES, identities, lowBits, lowWidth } from './bits.ts';
import { CellCipher, TAG_BYTES } from './cells.ts';
import { mostFrequentOf, NUMBER_BYTES, type Parameters, unpackCodewords, unpackParameters } from './parameters.ts';
import { salts } from './salts.ts';

const ASSOCIATED = ascii('keyss/v1/low-bits');
const DATA_KEY_BYTES = 16;
const SALTS_TRIED = 4;
const DUMMY_CELLS = 2; // of a carrier that a key which opens nothing looks into

/** The low bits of a model, prepared for any number of keys. */
export class LowBitsReader implements Reader {
  private constructor(
    private readonly names: Uint8Array, // [N, 16] identities
    private readonly low: Uint8Array, // [N, width]
    private readonly width: number,
    private readonly narrow: number, // bytes before harmonics above degree 1, which some secrets leave as they are
    readonly salts: Uint8Array[], // the likeliest first
  ) {}

  static of(model: Gaussians): LowBitsReader {
    let fields = fieldsOf(model);
    let [names, low] = [identities(model, fields), lowBits(fields)];
    const width = lowWidth(fields);
    const rows = firstOfEach(names, low, width);
    if (rows.length < model.count) {
      fields = fieldsOf(selected(model, rows));
      [names, low] = [rowsOf(names, rows, IDENTITY_BYTES), rowsOf(low, rows, width)];
    }
    return new LowBitsReader(names, low, width, lowWidth(fields, 9), salts(fields, names, low, width));
  }

  get derivations(): number {
    return Math.min(SALTS_TRIED, this.salts.length);
  }

  /** What `key` opens, null for nothing. Raises InputError for damage. */
  async open(key: string, derive: Derive = here): Promise<Content | null> {
    const room = this.width >= TAG_BYTES + DATA_KEY_BYTES;
    const dataKeys: Uint8Array[] = [];
    let secret = new Uint8Array(32);
    // Other workers derive what comes next while this one looks through the cells.
    const masters = this.salts.slice(0, this.derivations).map((salt) => derive(key, salt));
    for (const each of masters) {
      secret = new Uint8Array(expand(await each, 'low-bits/key', 32));
      if (!room) continue;
      const found = mostFrequentOf(this.decrypted(new CellCipher(secret, 'key', DATA_KEY_BYTES), this.width));
      if (found) dataKeys.push(found);
    }
    for (const dataKey of dataKeys) {
      for (const width of this.widths) {
        const parts = this.decrypted(this.parameterCipher(dataKey, width), width);
        if (parts.length) return this.content(dataKey, unpackParameters(parts), width);
      }
    }
    if (room && dataKeys.length === 0) this.passesForNothing(secret);
    return null;
  }

  private passesForNothing(secret: Uint8Array): void {
    const dataKey = expand(secret, 'low-bits/none', DATA_KEY_BYTES);
    for (const width of this.widths) this.decrypted(this.parameterCipher(dataKey, width), width);
    const size = Math.floor(this.width / DUMMY_CELLS) - TAG_BYTES;
    for (const label of ['record', 'copy']) this.decrypted(new CellCipher(dataKey, label, size), this.width, DUMMY_CELLS);
  }

  private async content(dataKey: Uint8Array, parameters: Parameters, width: number): Promise<Content> {
    const { isPayload, cells, recordBytes, method, header } = parameters;
    if (recordBytes < 1 || recordBytes > Math.floor(width / cells) - TAG_BYTES) throw damaged();
    const [records, copies] = ['record', 'copy'].map((label) =>
      this.decrypted(new CellCipher(dataKey, label, recordBytes), width, cells),
    );
    if (isPayload) {
      const [size, codewords] = unpackCodewords(parameters);
      const chunks = records.map((each): [number, Uint8Array] => [
        each[0] | (each[1] << 8) | (each[2] << 16), each.subarray(NUMBER_BYTES),
      ]);
      const encrypted = decoded(codewords, chunks).subarray(0, size);
      return { service: 'payload', method, data: await decrypted(expand(dataKey, 'payload-key', 32), encrypted, ASSOCIATED) };
    }
    const known = new Set(records.map(bytesKey));
    const all = [...records, ...copies.filter((each) => !known.has(bytesKey(each)))];
    if (!all.length) throw tooMuchLost();
    return { service: 'records', method, header, records: all };
  }

  /** Bytes of a Gaussian that carriers may have. */
  private get widths(): number[] {
    return [...new Set([this.width, this.narrow])].filter((width) => width >= TAG_BYTES + DATA_KEY_BYTES);
  }

  private parameterCipher(dataKey: Uint8Array, width: number): CellCipher {
    return new CellCipher(dataKey, 'parameters', width - TAG_BYTES);
  }

  /** What the cipher decrypts in any of the cells of each Gaussian's first bytes, in the order of these. */
  private decrypted(cipher: CellCipher, width: number, cells = 1): Uint8Array[] {
    const size = Math.floor(width / cells);
    const found: { row: number; data: Uint8Array }[] = [];
    for (let slot = 0; slot < cells; slot++) {
      const { rows, data } = cipher.decrypt(this.names, this.low, this.width, slot * size, slot);
      rows.forEach((row, index) => found.push({ row, data: data[index] }));
    }
    return found.sort((a, b) => a.row - b.row).map((each) => each.data);
  }
}

/** Rows of Gaussians, those that agree in identity and low bits only once. */
function firstOfEach(names: Uint8Array, low: Uint8Array, width: number): number[] {
  const seen = new Set<string>();
  const rows: number[] = [];
  for (let row = 0; row < names.length / IDENTITY_BYTES; row++) {
    const name = names.subarray(row * IDENTITY_BYTES, (row + 1) * IDENTITY_BYTES);
    const all = bytesKey(name) + bytesKey(low.subarray(row * width, (row + 1) * width));
    if (!seen.has(all)) rows.push(row);
    seen.add(all);
  }
  return rows;
}
