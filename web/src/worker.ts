/** The page's worker: reads models and tries keys. Nothing is stored. */
import DERIVE from 'source:./derive.ts';
import type { Reader } from './channels/content.ts';
import { preparedFor } from './channels/opening.ts';
import { InputError } from './core/errors.ts';
import { buffersOf, type Gaussians } from './core/gaussians.ts';
import { readModel } from './files/models.ts';
import { type Derive, deriveInWorker, roundRobin, sequential, startWorker } from './keys/keys.ts';
import { fileOf, type HiddenFile, secretOf } from './records/reveal.ts';

/** A file to read, or a key to try on the last file. */
export interface Question {
  readonly id?: number;
  readonly bytes?: Uint8Array;
  readonly name?: string; // some formats have no magic bytes
  readonly key?: string;
  readonly thorough?: boolean; // searches the slow channels
  readonly stop?: boolean; // cancels the current search
}

export interface Answer {
  readonly id: number;
  readonly model?: Gaussians;
  readonly leftOut?: number; // Gaussians dropped from the file
  readonly foreign?: number; // Gaussians added to or changed in the published file
  readonly file?: HiddenFile;
  readonly elsewhere?: boolean; // only `keyss reveal` opens the content
  readonly error?: string; // one sentence
  readonly stopped?: boolean; // the search was cancelled
  readonly progress?: number; // 0 to 1: an interim message, the same for every key
}

// Derivation dominates the time of an attempt, so several run in parallel, at 64 MiB each.
const DERIVERS = Math.max(1, Math.min(4, navigator.hardwareConcurrency || 2));
const derive = roundRobin(Array.from({ length: DERIVERS }, () => sequential(whileSearched(deriveInWorker(startWorker(DERIVE))))));
let searched: string | null = null; // the current key
let stego: Gaussians | null = null;
let prepared: Promise<((thorough: boolean) => Reader) | null> = Promise.resolve(null);

/** Rejects derivations of cancelled searches. */
function whileSearched(derive: Derive): Derive {
  return async (key, salt) => (key === searched ? derive(key, salt) : Promise.reject(new Error('stopped')));
}

function answer(message: Answer, moved: Transferable[] = []): void {
  (self as unknown as Worker).postMessage(message, moved);
}

async function load({ id = 0, name }: Question, bytes: Uint8Array): Promise<void> {
  const read = await readModel(bytes, name);
  const { codes, leftOut, ...model } = read;
  answer({ id, model, leftOut });
  stego = model;
  // After the answer, so that the picture comes first. Without enough memory no key opens anything.
  prepared = new Promise((resolve) => setTimeout(resolve, 0)).then(() => preparedFor(read)).catch(() => null);
}

async function unlock(id: number, key: string, thorough: boolean): Promise<void> {
  const reader = (await prepared)?.(thorough);
  searched = key;
  const content = reader ? await reader.open(key, counted(id, reader.derivations)) : null;
  answer({ id, progress: 1 }); // before decoding, which only right keys reach
  if (!content || !stego) return answer({ id });
  const [file, model, { foreign }] = [fileOf(content), secretOf(content, stego), content];
  if (model) answer({ id, model, foreign }, buffersOf(model));
  else answer(file ? { id, file, foreign } : { id, elsewhere: true });
}

/** `derive` that reports progress over `all` derivations. */
function counted(id: number, all: number): Derive {
  let done = 0;
  return async (key, salt) => {
    const found = await derive(key, salt);
    answer({ id, progress: ++done / (all + 1) }); // the rest takes about as long as one derivation
    return found;
  };
}

self.onmessage = async ({ data }: MessageEvent<Question>) => {
  const { id = 0 } = data;
  try {
    if (data.stop) searched = null;
    else if (data.bytes) await load(data, data.bytes);
    else await unlock(id, data.key ?? '', data.thorough ?? false);
  } catch (error) {
    const message = error instanceof InputError ? error.message : 'This file cannot be read.';
    // Errors of a key are indistinguishable from a wrong key.
    answer(data.bytes ? { id, error: message } : { id });
  }
};

