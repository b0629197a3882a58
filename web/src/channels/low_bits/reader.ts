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
const LEAST_WIDTH = TAG_BYTES + DATA_KEY_BYTES;
const SALTS_TRIED = 4;
const DUMMY_CELLS = 2; // of a carrier that a key which opens nothing looks into
const NARROW_HARMONICS = 9; // of degree 1: some secrets leave the low bits of the others as they are

/** The low bits of a model, prepared for any number of keys. */
export class LowBitsReader implements Reader {
  private constructor(
    private readonly names: Uint8Array, // [N, 16] identities
    private readonly low: Uint8Array, // [N, width]
    private readonly width: number,
    private readonly widths: readonly number[], // that a secret may use
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
    const widths = [...new Set([width, lowWidth(fields, NARROW_HARMONICS)])].filter((each) => each >= LEAST_WIDTH);
    return new LowBitsReader(names, low, width, widths, salts(fields, names, low, width));
  }

  get derivations(): number {
    return Math.min(SALTS_TRIED, this.salts.length);
  }

  /** What `key` opens, null for nothing. Raises InputError for damage. */
  async open(key: string, derive: Derive = here): Promise<Content | null> {
    const dataKeys: Uint8Array[] = [];
    let secret = new Uint8Array(32);
    // Other workers derive what comes next while this one looks through the cells.
    const masters = this.salts.slice(0, this.derivations).map((salt) => derive(key, salt));
    for (const each of masters) {
      secret = new Uint8Array(expand(await each, 'low-bits/key', 32));
      if (!this.widths.length) continue;
      const found = mostFrequentOf(this.decrypted(new CellCipher(secret, 'key', DATA_KEY_BYTES)));
      if (found) dataKeys.push(found);
    }
    for (const dataKey of dataKeys) {
      const every = this.widths.map((width) => [width, this.parts(dataKey, width)] as const);
      const found = every.find(([, parts]) => parts.length);
      if (found) return this.content(dataKey, unpackParameters(found[1]), found[0]);
    }
    if (dataKeys.length === 0 && this.widths.length) {
      const none = expand(secret, 'low-bits/none', DATA_KEY_BYTES);
      for (const width of this.widths) this.parts(none, width);
      this.passesForNothing(none, this.width);
    }
    return null;
  }

  private passesForNothing(dataKey: Uint8Array, width: number): void {
    const size = Math.floor(width / DUMMY_CELLS) - TAG_BYTES;
    for (const label of ['record', 'copy']) this.decrypted(new CellCipher(dataKey, label, size), width, DUMMY_CELLS);
  }

  private async content(dataKey: Uint8Array, parameters: Parameters, width: number): Promise<Content> {
    const { isPayload, cells, recordBytes, method, header } = parameters;
    if (recordBytes < 1 || recordBytes > Math.floor(width / cells) - TAG_BYTES) throw damaged();
    const [records, copies] = ['record', 'copy'].map((label) =>
      this.decrypted(new CellCipher(dataKey, label, recordBytes), width, cells),
    );
    if (width < this.width) this.passesForNothing(dataKey, this.width - width);
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

  private parts(dataKey: Uint8Array, width: number): Uint8Array[] {
    return this.decrypted(new CellCipher(dataKey, 'parameters', width - TAG_BYTES));
  }

  /** What the cipher decrypts in any of the cells of each Gaussian, in the order of these. */
  private decrypted(cipher: CellCipher, width = this.width, cells = 1): Uint8Array[] {
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
