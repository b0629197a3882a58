/** What the page and its worker tell each other. */
import type { Gaussians } from './core/gaussians.ts';

/** Bytes of a file to be read, or a key to be tried on the one before. */
export interface Question {
  readonly id: number;
  readonly bytes?: Uint8Array;
  readonly name?: string; // of the file; some formats are known by it only
  readonly keyless?: boolean; // no key will be tried on these bytes
  readonly key?: string;
  readonly colours?: boolean; // whether the key is tried on these, too
}

export interface Answer {
  readonly id: number;
  readonly model?: Gaussians;
  readonly file?: { readonly name: string; readonly data: Uint8Array };
  readonly error?: string; // one sentence
  readonly progress?: number; // 0 to 1: not the answer yet, and the same for every key
}
