/**
 * Key derivation and decryption (docs/byte-layout.md); counterpart of `keyss.keys`. Argon2id (RFC 9106) of the key in NFKC
 * without surrounding white space, then HKDF-Expand with SHA-256 (RFC 5869) with a label for each use.
 */
import { chacha20, chacha20poly1305 } from '@noble/ciphers/chacha.js';
import { hmac } from '@noble/hashes/hmac.js';
import { sha256 } from '@noble/hashes/sha2.js';
import { argon2id } from 'hash-wasm';
import { ascii, inflate, joined, viewOf } from '../core/bytes.ts';
import { damaged, InputError } from '../core/errors.ts';

export const SALT_BYTES = 16;
const MAX_KEY_BYTES = 4096;

/** The bytes of a key. Raises InputError for an empty one and one of more than 4,096 bytes. */
export function keyBytes(key: string): Uint8Array {
  const bytes = new TextEncoder().encode(key.normalize('NFKC').trim());
  if (bytes.length === 0 || bytes.length > MAX_KEY_BYTES) {
    throw new InputError('A key has 1 to 4,096 bytes.');
  }
  return bytes;
}

/** `master`, here or in another worker. */
export type Derive = (key: string, salt: Uint8Array) => Promise<Uint8Array>;

/** 32 bytes. Takes some tenths of a second and 64 MiB. */
export function master(key: string, salt: Uint8Array): Promise<Uint8Array> {
  const password = keyBytes(key);
  return argon2id({ password, salt, iterations: 3, memorySize: 65536, parallelism: 4, hashLength: 32, outputType: 'binary' });
}

/** 32 bytes, the first block of HKDF-Expand, for one use of a uniformly random `secret`. */
export function expand(secret: Uint8Array, label: string): Uint8Array {
  // Not by the library, which refuses secrets of less than 32 bytes; data keys have 16.
  return hmac(sha256, secret, joined(ascii(`keyss/v1/${label}`), Uint8Array.of(1)));
}

const AT_ONCE = 1 << 16; // bytes of a stream

/** Expands beyond the limit of HKDF: little-endian 32-bit words of ChaCha20's key stream (RFC 8439) under a derived key. */
export function streamWords(
  secret: Uint8Array, label: string, count: number, take: (word: number, at: number) => void,
): void {
  const [key, nonce] = [expand(secret, label), new Uint8Array(12)];
  const zeros = new Uint8Array(AT_ONCE);
  const bytes = new Uint8Array(AT_ONCE);
  const view = viewOf(bytes);
  for (let at = 0; at < count; at += AT_ONCE / 4) {
    chacha20(key, nonce, zeros, bytes, (at * 4) / 64);
    const end = Math.min(AT_ONCE / 4, count - at);
    for (let index = 0; index < end; index++) take(view.getUint32(4 * index, true), at + index);
  }
}

const COMPRESSED = 2 ** 31; // flag in the length
const MAX_PAYLOAD_BYTES = 256 << 20;
const [MAX_RATIO, SMALL_PAYLOAD] = [16, 1 << 20]; // n bytes inflate to at most MAX_RATIO n + SMALL_PAYLOAD

/** Inverse of `keyss.keys.encryption.encrypt`. Raises InputError for any modification. */
export async function decrypted(
  dataKey: Uint8Array, encrypted: Uint8Array, associated: Uint8Array,
): Promise<Uint8Array> {
  let plain: Uint8Array;
  try {
    plain = chacha20poly1305(expand(dataKey, 'payload'), new Uint8Array(12), associated).decrypt(encrypted);
  } catch {
    throw damaged();
  }
  const prefix = plain.length >= 4 ? viewOf(plain).getUint32(0, true) : plain.length;
  const length = prefix % COMPRESSED;
  if (4 + length > plain.length) throw damaged();
  const packed = plain.subarray(4, 4 + length);
  if (prefix < COMPRESSED) return packed;
  return inflate(packed, 'deflate', Math.min(MAX_PAYLOAD_BYTES, MAX_RATIO * length + SMALL_PAYLOAD));
}

/** `derive` with at most one derivation at a time, since each takes 64 MiB. */
export function sequential(derive: Derive): Derive {
  let last: Promise<unknown> = Promise.resolve();
  return (key, salt) => {
    const own = last.then(() => derive(key, salt));
    last = own.catch(() => undefined);
    return own;
  };
}

/** Distributes derivations over several. */
export function roundRobin(derives: readonly Derive[]): Derive {
  let next = 0;
  return (key, salt) => derives[next++ % derives.length](key, salt);
}

/** In this thread. */
export const here: Derive = sequential(master);

/** By a worker that answers with 32 bytes or null, asked sequentially. */
export function deriveInWorker(worker: Worker): Derive {
  return (key, salt) =>
    new Promise((resolve, reject) => {
      worker.onmessage = ({ data }: MessageEvent<Uint8Array | null>) => (data ? resolve(data) : reject(new Error('no memory')));
      worker.postMessage({ key, salt });
    });
}

/** A worker from a blob, the only kind in a single-file page that opens from disk. */
export function startWorker(source: string): Worker {
  return new Worker(URL.createObjectURL(new Blob([source], { type: 'text/javascript' })));
}
