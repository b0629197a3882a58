/** What takes time: files into models, and what keys open in them. Nothing of it outlives the page. */
import { InputError } from './core/errors.ts';
import DERIVE from 'source:./derive.ts';
import type { Content, Reader } from './channels/content.ts';
import { preparedFor } from './channels/opening.ts';
import { buffersOf, type Gaussians } from './core/gaussians.ts';
import { readModel, type ReadModel } from './files/models.ts';
import type { Derive } from './keys/derivation.ts';
import { derivedBy, inTurn, started } from './keys/pool.ts';
import { secretOf } from './records/secret.ts';
import type { Answer, Question } from './protocol.ts';

// Keys are derived side by side: each takes 64 MiB, and most of the time of an attempt.
const DERIVERS = Math.max(1, Math.min(4, navigator.hardwareConcurrency || 2));
const derive = inTurn(Array.from({ length: DERIVERS }, () => derivedBy(started(DERIVE))));
let stego: Gaussians | null = null;
let prepared: Promise<((colours: boolean) => Reader) | null> = Promise.resolve(null);

function answer(message: Answer, moved: Transferable[] = []): void {
  (self as unknown as Worker).postMessage(message, moved);
}

async function load({ id, name, keyless }: Question, bytes: Uint8Array): Promise<void> {
  const read = await readModel(bytes, name);
  const { codes, ...model } = read;
  answer({ id, model }, keyless ? buffersOf(model) : []);
  if (keyless) return;
  stego = model;
  // Afterwards: the picture comes first.
  prepared = new Promise((resolve) => setTimeout(() => resolve(preparedWhereThereIsMemory(read)), 0));
}

function preparedWhereThereIsMemory(model: ReadModel): ((colours: boolean) => Reader) | null {
  try {
    return preparedFor(model);
  } catch {
    return null; // it opens nothing, and the page goes on
  }
}

async function unlock(id: number, key: string, colours: boolean): Promise<void> {
  const reader = (await prepared)?.(colours);
  const content = reader ? await reader.open(key, counted(id, reader.derivations)) : null;
  answer({ id, progress: 1 }); // before the secret is decoded, which wrong keys have no part in
  const model = content && stego && secretOf(content, stego)?.gaussians;
  if (model) answer({ id, model }, buffersOf(model));
  else answer({ id, file: content ? fileOf(content) : undefined });
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

/** A hidden file: its name, which is to be shown and never to be taken as a path, and its bytes. */
function fileOf(content: Content): { name: string; data: Uint8Array } | undefined {
  if (content.service !== 'payload' || content.method !== 'file') return undefined;
  const size = content.data[0];
  const name = new TextDecoder().decode(content.data.subarray(1, 1 + size));
  return { name, data: content.data.slice(1 + size) };
}

self.onmessage = async ({ data }: MessageEvent<Question>) => {
  try {
    if (data.bytes) await load(data, data.bytes);
    else await unlock(data.id, data.key ?? '', data.colours ?? false);
  } catch (error) {
    const message = error instanceof InputError ? error.message : 'This file cannot be read.';
    // A key's failures say no more than a key that opens nothing does.
    answer(data.bytes ? { id: data.id, error: message } : { id: data.id });
  }
};

