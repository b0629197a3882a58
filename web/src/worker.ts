/** Reads models and tries keys in a thread of its own. Nothing is stored. */
import DERIVE from 'source:./derive.ts';
import type { Reader } from './channels/container.ts';
import { channelsOf } from './channels/opening.ts';
import { InputError } from './core/errors.ts';
import { buffersOf, type Gaussians, opacitiesAreBytes } from './core/gaussians.ts';
import { readModel } from './files/models.ts';
import { fileOf, type HiddenFile, secretOf } from './hidden.ts';
import { type Derive, deriveInWorker, roundRobin, sequential, startWorker } from './keys/keys.ts';

/** A file to read; a key to try on it; or a key and a model to search thoroughly. Answers go to the port that comes with it. */
export interface Question {
  readonly bytes?: Uint8Array;
  readonly name?: string; // some formats have no magic bytes
  readonly key?: string;
  readonly model?: Gaussians; // of SH degree 0, for the slow channels
  readonly silent?: boolean; // nobody waits: leaves the other processors to the picture
}

export interface Answer {
  readonly model?: Gaussians;
  readonly wasDecoded?: boolean; // a .ply decoded from a compressed file, in which only `keyss reveal` finds secrets
  readonly foreign?: number; // Gaussians added to or changed in the published file
  readonly file?: HiddenFile;
  readonly elsewhere?: boolean; // only `keyss reveal` opens the payload
  readonly error?: string; // one sentence
  readonly stopped?: boolean; // the search was cancelled
  readonly progress?: number; // 0 to 1: an interim message, the same for every key
}

type Tell = (answer: Answer, moved?: Transferable[]) => void;

// Derivation dominates the time of an attempt, so several run in parallel, at 64 MiB each.
const DERIVERS = Math.max(1, Math.min(4, navigator.hardwareConcurrency || 2));
let derive: Derive | null = null;
let stego: Gaussians | null = null;
let prepared: Promise<Reader | null> = Promise.resolve(null);

async function load(bytes: Uint8Array, name: string | undefined, tell: Tell): Promise<void> {
  const read = await readModel(bytes, name);
  const { codes, ...model } = read;
  tell({ model, wasDecoded: !codes && opacitiesAreBytes(model) });
  stego = model;
  // After the answer, so that the picture comes first. Without enough memory no key opens anything.
  prepared = new Promise((resolve) => setTimeout(resolve, 0)).then(() => channelsOf(read, false)).catch(() => null);
}

function derivers(count: number): Derive {
  return roundRobin(Array.from({ length: count }, () => sequential(deriveInWorker(startWorker(DERIVE)))));
}

async function unlock(key: string, derive: Derive, tell: Tell): Promise<void> {
  const [reader, model] = [await prepared, stego];
  let done = 0;
  const payload = await reader?.open(key, async (own, salt) => {
    const found = await derive(own, salt);
    tell({ progress: ++done / (reader.derivations + 1) }); // the rest takes about as long as one derivation
    return found;
  });
  tell({ progress: 1 }); // before decoding, which only right keys reach
  if (!payload || !model) return tell({});
  const [file, secret, { foreign }] = [fileOf(payload), secretOf(payload, model), payload];
  if (secret) tell({ model: secret, foreign }, buffersOf(secret));
  else tell(file ? { file, foreign } : { elsewhere: true });
}

self.onmessage = async ({ data, ports: [port] }: MessageEvent<Question>) => {
  const tell: Tell = (answer, moved = []) => port.postMessage(answer, moved);
  try {
    derive ??= derivers(data.silent ? 1 : DERIVERS);
    if (data.model) {
      stego = data.model;
      prepared = channelsOf(data.model, true);
    }
    if (data.bytes) await load(data.bytes, data.name, tell);
    else await unlock(data.key ?? '', derive, tell);
  } catch (error) {
    const message = error instanceof InputError ? error.message : 'This file cannot be read.';
    // Errors of a key are indistinguishable from a wrong key.
    tell(data.bytes ? { error: message } : {});
  }
};
