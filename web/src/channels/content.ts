/** What every channel of a model gives. */
import type { Derive } from '../keys/derivation.ts';

/** Small pieces of one size that are found one by one. */
export interface Records {
  readonly service: 'records';
  readonly method: string;
  readonly header: Uint8Array;
  readonly records: Uint8Array[]; // in the order of their carriers
}

/** Bytes that come out whole or not at all. */
export interface Payload {
  readonly service: 'payload';
  readonly method: string;
  readonly data: Uint8Array;
}

export type Content = Records | Payload;

/** A channel of one model, prepared for any number of keys. */
export interface Reader {
  /** Keys that each attempt derives, whatever it opens. */
  readonly derivations: number;

  /** What `key` opens, null for nothing. Raises InputError for damage. */
  open(key: string, derive?: Derive): Promise<Content | null>;
}
