/** The source of the page's model: embedded, beside the page, or given in its address. */
import { readAll } from '../core/bytes.ts';
import { params } from './embedding.ts';

export interface Source {
  readonly name: string;
  readonly bytes: (loaded: (share: number) => void) => Promise<Uint8Array>;
}

/** Null if there is none. */
export function givenModel(): Source | null {
  const inside = document.getElementById('model');
  const beside = document.querySelector<HTMLMetaElement>('meta[name="keyss-model"]')?.content;
  if (inside?.textContent && !params.file) {
    const text = inside.textContent;
    inside.remove(); // frees memory
    return { name: inside.dataset.name ?? 'model', bytes: async () => bytesOfBase64(text) };
  }
  const address = params.file ?? beside;
  if (!address) return null;
  const url = new URL(address, document.baseURI);
  const named = url.pathname.split('/').pop()!.replaceAll('+', '%2B');
  return { name: new URLSearchParams(`name=${named}`).get('name') || 'model', bytes: (loaded) => fetchBytes(url, loaded) };
}

/** `loaded` receives the share loaded so far. Throws for missing files and hosts that are not allowed. */
async function fetchBytes(url: URL, loaded: (share: number) => void): Promise<Uint8Array> {
  const response = await fetch(url, { credentials: 'omit' });
  if (!response.ok || response.body === null) throw new Error(String(response.status));
  const size = Number(response.headers.get('content-length')); // possibly compressed
  return readAll(response.body, (bytes) => size && loaded(Math.min(1, bytes / size)));
}

function bytesOfBase64(text: string): Uint8Array {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let at = 0; at < binary.length; at++) bytes[at] = binary.charCodeAt(at);
  return bytes;
}
