/** A secret of the design `carriers`, row by row in harmonics; `keyss.methods.keyss.rows` in Python says why. */
import { sha256 } from '@noble/hashes/sha2.js';
import { fieldsOf, IDENTITY_BYTES, identities } from '../channels/low_bits/bits.ts';
import { CellCipher } from '../channels/low_bits/cells.ts';
import { rowsOf } from '../core/bytes.ts';
import { changed, damaged } from '../core/errors.ts';
import { compensated, emptyGaussians, type Gaussians, opacity, withDegree } from '../core/gaussians.ts';
import { expand } from '../keys/keys.ts';
import { Codec } from '../records/codec.ts';
import type { Tensors } from './safetensors.ts';

const KINDS = [40, 24]; // of rows: carriers that are used where at least so many harmonics are not zero
const BITS = 7; // of a carrier
const SHIFT = 13; // bits of a harmonic below its carrier
const EMBEDDING_NUMBERS = 64;
const MAX_SECRETS = 9;
const LEAST = 1e-6; // share of the visibility that is left

/** Rows of a model with equally many carriers in use. */
interface RowKind {
  readonly rows: number[]; // [R]
  readonly width: number; // bytes that the carriers of a row say
  readonly data: Uint8Array; // [R, width]
}

/** The Gaussians that the rows of `model` hold. Raises InputError for damage, and where no row opens. */
export function decodeRows(header: Record<string, unknown>, { tensors }: Tensors, model: Gaussians): Gaussians {
  const [secret, secrets, visibility] = [header.secret, header.secrets, header.visibility] as number[];
  const whole = [secret, secrets].every(Number.isInteger) && secret >= 0 && secret < secrets && secrets <= MAX_SECRETS;
  const embedding = tensors.get('embedding');
  if (!whole || !(visibility > 0) || embedding?.shape.join() !== String(EMBEDDING_NUMBERS)) throw damaged();
  const codecs = [...Array(tensors.size - 1).keys()].map((index) => {
    const packed = tensors.get(`codec.${index}`);
    if (!packed || index >= KINDS.length) throw damaged();
    return Codec.unpack(Uint8Array.from(packed.values));
  });
  if (!codecs.length) throw damaged();
  const key = expand(sha256(new Uint8Array(embedding.values.buffer)), 'carriers', 32);
  const bare = withDegree(model, 0);
  const names = identities(bare, fieldsOf(bare));
  const records = rowKinds(model).slice(0, codecs.length).map(({ rows, width, data }, index) => {
    const [cipher, share] = [new CellCipher(key, 'carriers', codecs[index].recordBytes), Math.floor(width / secrets)];
    if (cipher.cellBytes > share) return [];
    return cipher.decrypt(rowsOf(names, rows, IDENTITY_BYTES), data, width, secret * share, secret).data;
  });
  const count = records.reduce((sum, each) => sum + each.length, 0);
  if (!count) throw changed();
  const found = emptyGaussians(count, Math.max(...codecs.map((each) => each.shDegree)));
  records.forEach((each, index) => codecs[index].decode(each, found, index ? records[0].length : 0));
  const seen = found.opacityLogits.reduce((sum, each) => sum + opacity(each), 0);
  return compensated(found, Math.round(count / Math.max(Math.min(1, seen / visibility), LEAST)));
}

/** The rows of each kind that there can be, in order. */
function rowKinds(model: Gaussians): RowKind[] {
  const all = model.sh.length / model.count;
  const words = new Uint32Array(model.sh.buffer, model.sh.byteOffset, model.sh.length);
  const usable = (row: number): Uint32Array =>
    words.subarray(all * row + 3, all * (row + 1)).filter((word) => ((word >>> 23) & 255) % 255 !== 0);
  const counts = Uint8Array.from({ length: model.count }, (_, row) => usable(row).length);
  const every = [...counts.keys()];
  return KINDS.filter((carriers) => carriers <= all - 3).map((carriers, index) => {
    const most = index ? KINDS[index - 1] : all;
    const rows = every.filter((row) => counts[row] >= carriers && counts[row] < most);
    const width = (carriers * BITS) / 8;
    const data = new Uint8Array(rows.length * width);
    rows.forEach((row, to) => usable(row).subarray(0, carriers).forEach((word, at) => {
      const carrier = (word >>> SHIFT) & 255;
      const said = Math.min(carrier, 255 - carrier);
      for (let bit = BITS * at, left = BITS - 1; left >= 0; bit++, left--) {
        data[width * to + (bit >> 3)] |= ((said >> left) & 1) << (7 - (bit & 7));
      }
    }));
    return { rows, width, data };
  });
}
