/**
 * The container, the same in every channel (docs/byte-layout.md): payloads, sealed bytes and parameters; counterpart of
 * `keyss.channels.container`.
 */
import { ascii, bytesKey, joined, viewOf } from '../core/bytes.ts';
import { damaged, InputError, otherVersion } from '../core/errors.ts';
import { decrypted, type Derive, expand, here, streamWords } from '../keys/keys.ts';
import { type Codewords, decoded, type Shards } from './reed_solomon.ts';

/** Bytes that are read completely or not at all. */
export interface Payload {
  readonly method: string;
  readonly data: Uint8Array;
  readonly foreign?: number; // Gaussians added to or changed in the published file
}

/** A channel of one model, prepared for any number of keys. */
export interface Reader {
  /** Number of key derivations per attempt, whatever it opens. */
  readonly derivations: number;

  /** The payload that `key` opens, or null. Raises InputError for damage. */
  open(key: string, derive?: Derive): Promise<Payload | null>;
}

const ASSOCIATED = ascii('keyss/v1/payload');
const METHOD_BYTES = 15;
const VERSION = 1;
const CHECK_BYTES = 8;
export const PARAMETER_BYTES = CHECK_BYTES + 10;

/** Tries a key with all `salts`, whatever it opens; `extract`: the payload under the secret of a key and one salt, or null. */
export function saltedReader(salts: readonly Uint8Array[], extract: (secret: Uint8Array) => Promise<Payload | null>): Reader {
  return {
    derivations: salts.length,
    async open(key, derive = here) {
      const masters = salts.map((salt) => derive(key, salt)); // in other workers, while this one reads
      let found: Payload | null = null;
      for (const each of masters) {
        const secret = keySecret(await each);
        found ??= await extract(secret);
      }
      return found;
    },
  };
}

/** What a key under a salt decrypts with. It is the data key of a file with one salt. */
export function keySecret(master: Uint8Array): Uint8Array {
  return expand(master, 'channel/key');
}

/** The record and the payload of sealed bytes. Raises InputError for damage. */
export async function unsealed(dataKey: Uint8Array, sealed: Uint8Array, recordBytes = 0): Promise<[Uint8Array, Payload]> {
  if (sealed.length < recordBytes) throw damaged();
  const record = sealed.slice(0, recordBytes);
  const [masked, view] = [viewOf(sealed), viewOf(record)];
  streamWords(dataKey, 'record', recordBytes / 4, (word, at) => view.setUint32(4 * at, masked.getUint32(4 * at, true) ^ word, true));
  const key = expand(dataKey, 'payload-key');
  return [record, unpackPayload(await decrypted(key, sealed.subarray(recordBytes), joined(ASSOCIATED, record)))];
}

/** `unsealed` from numbered shards; looks for false ones only if authentication fails. */
export async function unsealedShards(
  dataKey: Uint8Array, codewords: Codewords, shards: Shards, recordBytes: number,
): Promise<[Uint8Array, Payload]> {
  try {
    return await unsealed(dataKey, decoded(codewords, shards, false), recordBytes);
  } catch (error) {
    if (!(error instanceof InputError)) throw error;
    return unsealed(dataKey, decoded(codewords, shards, true), recordBytes);
  }
}

/** Parses method name, zero byte, data. */
export function unpackPayload(packed: Uint8Array): Payload {
  const length = packed.indexOf(0);
  const name = packed.subarray(0, length);
  if (length < 1 || length > METHOD_BYTES || name.some((each) => each > 127)) throw damaged();
  return { method: bytesKey(name), data: packed.slice(length + 1) };
}

/** How the shards of a payload lie in slots; perhaps impossible. */
export interface Parameters {
  readonly depth: number; // what shards take of each slot: bits of each number, or bytes of a block
  readonly count: number; // codewords
  readonly n: number; // shards of a codeword
  readonly k: number; // data shards of a codeword
}

/** The first bytes of parameters. */
export function checkOf(dataKey: Uint8Array): Uint8Array {
  return expand(dataKey, 'check').subarray(0, CHECK_BYTES);
}

/** Null if the data key is wrong. Raises InputError for another version. */
export function unpackedParameters(packed: Uint8Array, dataKey: Uint8Array): Parameters | null {
  const check = checkOf(dataKey);
  if (!check.every((each, at) => each === packed[at])) return null;
  const view = viewOf(packed.subarray(CHECK_BYTES));
  if (view.getUint8(0) !== VERSION) throw otherVersion();
  return { depth: view.getUint8(1), count: view.getUint32(2, true), n: view.getUint16(6, true), k: view.getUint16(8, true) };
}
