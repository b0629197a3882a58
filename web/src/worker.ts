/** What takes time: files into models, and what keys open in them. Nothing of it outlives the page. */
import { InputError } from './core/errors.ts';
import DERIVE from 'source:./derive.ts';
import type { Reader } from './channels/content.ts';
import { preparedFor } from './channels/opening.ts';
import { buffersOf, type Gaussians } from './core/gaussians.ts';
import { readModel } from './files/models.ts';
import type { Derive } from './keys/keys.ts';
import { derivedBy, inTurn, oneByOne, started } from './keys/pool.ts';
import { fileOf, type HiddenFile } from './records/file.ts';
import { secretOf } from './records/secret.ts';

/** Bytes of a file to be read, or a key to be tried on the one before. */
export interface Question {
  readonly id?: number;
  readonly bytes?: Uint8Array;
  readonly name?: string; // of the file; some formats are known by it only
  readonly keyless?: boolean; // no key will be tried on these bytes
  readonly key?: string;
  readonly thorough?: boolean; // the key is tried on the channels that take long
  readonly stop?: boolean; // the search that goes on
}

export interface Answer {
  readonly id: number;
  readonly model?: Gaussians;
  readonly leftOut?: number; // Gaussians of its file
  readonly foreign?: number; // Gaussians that were added to the secret's file, or changed
  readonly file?: HiddenFile;
  readonly error?: string; // one sentence
  readonly stopped?: boolean; // a search, before its end
  readonly progress?: number; // 0 to 1: not the answer yet, and the same for every key
}

// Keys are derived side by side: each takes 64 MiB, and most of the time of an attempt.
const DERIVERS = Math.max(1, Math.min(4, navigator.hardwareConcurrency || 2));
const derive = inTurn(Array.from({ length: DERIVERS }, () => oneByOne(whileSearched(derivedBy(started(DERIVE))))));
let searched: string | null = null; // the key of now
let stego: Gaussians | null = null;
let prepared: Promise<((thorough: boolean) => Reader) | null> = Promise.resolve(null);

/** The keys of a search that was stopped are not derived. */
function whileSearched(derive: Derive): Derive {
  return async (key, salt) => (key === searched ? derive(key, salt) : Promise.reject(new Error('stopped')));
}

function answer(message: Answer, moved: Transferable[] = []): void {
  (self as unknown as Worker).postMessage(message, moved);
}

async function load({ id = 0, name, keyless }: Question, bytes: Uint8Array): Promise<void> {
  const read = await readModel(bytes, name);
  const { codes, leftOut, ...model } = read;
  answer({ id, model, leftOut }, keyless ? buffersOf(model) : []);
  if (keyless) return;
  stego = model;
  // Afterwards: the picture comes first. Where there is no memory nothing opens, and the page goes on.
  prepared = new Promise((resolve) => setTimeout(resolve, 0)).then(() => preparedFor(read)).catch(() => null);
}

async function unlock(id: number, key: string, thorough: boolean): Promise<void> {
  const reader = (await prepared)?.(thorough);
  searched = key;
  const content = reader ? await reader.open(key, counted(id, reader.derivations)) : null;
  answer({ id, progress: 1 }); // before the secret is decoded, which wrong keys have no part in
  const model = content && stego && secretOf(content, stego)?.gaussians;
  const foreign = content?.foreign;
  if (model) answer({ id, model, foreign }, buffersOf(model));
  else answer({ id, file: (content && fileOf(content)) ?? undefined, foreign });
}

/** `derive`, telling the page how many of so many keys have been derived. */
function counted(id: number, all: number): Derive {
  let done = 0;
  return async (key, salt) => {
    const found = await derive(key, salt);
    answer({ id, progress: ++done / (all + 1) }); // what comes after takes as long as one more
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
    // A key's failures say no more than a key that opens nothing does.
    answer(data.bytes ? { id, error: message } : { id });
  }
};

