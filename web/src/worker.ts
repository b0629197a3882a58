/** What takes time: files into models, and what keys open in them. Nothing of it outlives the page. */
import type { Content, Reader } from './channels/content.ts';
import { readerOf } from './channels/opening.ts';
import { InputError } from './core/errors.ts';
import { buffersOf, type Gaussians } from './core/gaussians.ts';
import { readModel, type ReadModel } from './files/models.ts';
import { secretOf } from './records/secret.ts';
import type { Answer, Question } from './protocol.ts';

let port: MessagePort | null = null;
let stego: Gaussians | null = null;
let prepared: Promise<Reader | null> = Promise.resolve(null);

function answer(message: Answer, moved: Transferable[] = []): void {
  (self as unknown as Worker).postMessage(message, moved);
}

async function load(id: number, bytes: Uint8Array): Promise<void> {
  const read = await readModel(bytes);
  const { codes, ...model } = read;
  answer({ id, model });
  stego = model;
  // Afterwards: the picture comes first.
  prepared = new Promise((resolve) => setTimeout(() => resolve(readerWhereThereIsMemory(read)), 0));
}

function readerWhereThereIsMemory(model: ReadModel): Reader | null {
  try {
    return readerOf(model);
  } catch {
    return null; // it opens nothing, and the page goes on
  }
}

/** What a key becomes with a salt, by the worker at the other end of the port that the page gave. */
const derive = (key: string, salt: Uint8Array): Promise<Uint8Array> =>
  new Promise((resolve, reject) => {
    if (port === null) throw new Error('no port');
    port.onmessage = ({ data }: MessageEvent<Uint8Array | null>) =>
      data === null ? reject(new Error('no memory')) : resolve(data);
    port.postMessage({ key, salt });
  });

async function unlock(id: number, key: string): Promise<void> {
  const reader = await prepared;
  const content = reader === null ? null : await reader.open(key, derive);
  const model = content && stego && secretOf(content, stego)?.gaussians;
  if (model) answer({ id, model }, buffersOf(model));
  else answer({ id, file: content ? fileOf(content) : undefined });
}

/** A hidden file: its name, which is to be shown and never to be taken as a path, and its bytes. */
function fileOf(content: Content): { name: string; data: Uint8Array } | undefined {
  if (content.service !== 'payload' || content.method !== 'file') return undefined;
  const size = content.data[0];
  const name = new TextDecoder().decode(content.data.subarray(1, 1 + size));
  return { name, data: content.data.slice(1 + size) };
}

self.onmessage = async ({ data }: MessageEvent<Question>) => {
  if (data.port) {
    port = data.port;
    return;
  }
  try {
    if (data.bytes) await load(data.id, data.bytes);
    else await unlock(data.id, data.key ?? '');
  } catch (error) {
    const message = error instanceof InputError ? error.message : 'This file cannot be read.';
    // A key's failures say no more than a key that opens nothing does.
    answer(data.bytes ? { id: data.id, error: message } : { id: data.id });
  }
};

