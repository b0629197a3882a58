/** Where the page has its model from: within itself, beside it, or in its address. */
import { joined } from '../core/bytes.ts';
import { asked } from './embedding.ts';

export interface Source {
  readonly name: string;
  readonly bytes: (loaded: (share: number) => void) => Promise<Uint8Array>;
}

/** Null where there is none. */
export function givenModel(): Source | null {
  const inside = document.getElementById('model');
  const beside = document.querySelector<HTMLMetaElement>('meta[name="keyss-model"]')?.content;
  if (inside?.textContent && !asked.file) {
    const text = inside.textContent;
    inside.remove(); // the text is not needed twice
    return { name: inside.dataset.name ?? 'model', bytes: async () => bytesOfBase64(text) };
  }
  const address = asked.file ?? beside;
  if (!address) return null;
  const url = new URL(address, document.baseURI);
  const named = url.pathname.split('/').pop()!.replaceAll('+', '%2B');
  return { name: new URLSearchParams(`name=${named}`).get('name') || 'model', bytes: (loaded) => fetched(url, loaded) };
}

/** `loaded` gets the share that is there. Raises an error for what is not there, or on a host that is not allowed. */
export async function fetched(url: URL | string, loaded: (share: number) => void = () => undefined): Promise<Uint8Array> {
  const response = await fetch(url, { credentials: 'omit' });
  if (!response.ok || response.body === null) throw new Error(String(response.status));
  const size = Number(response.headers.get('content-length')); // of what may be compressed
  const parts: Uint8Array[] = [];
  const reader = response.body.getReader();
  for (let [bytes, { done, value }] = [0, await reader.read()]; !done; { done, value } = await reader.read()) {
    parts.push(value!);
    bytes += value!.length;
    if (size) loaded(Math.min(1, bytes / size));
  }
  return joined(...parts);
}

function bytesOfBase64(text: string): Uint8Array {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let at = 0; at < binary.length; at++) bytes[at] = binary.charCodeAt(at);
  return bytes;
}
