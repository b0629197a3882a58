/** Embedding in other sites: options in the page's address, messages to the parent page, and where the model comes from. */
import { readAll } from '../core/bytes.ts';
import { page } from './panel.ts';

const query = new URLSearchParams(location.search);

export const params = {
  file: query.get('file'),
  title: query.get('title'),
  poster: query.get('poster'), // shown until the model is drawn
  autorotate: query.has('autorotate'),
  panel: query.has('key-field') ? 'key' : query.has('noui') ? 'none' : 'all',
};

export type EmbedEvent =
  | { readonly event: 'load'; readonly gaussians: number }
  | { readonly event: 'key-tried' }
  | { readonly event: 'opened'; readonly kind: 'model' | 'file' };

/**
 * Posts to the parent page if its origin is the one that the publisher named, or this page's own. Other sites that frame
 * the page must not learn whether a visitor's key opened something.
 */
export function notifyParent(event: EmbedEvent): void {
  const origin = page.main.dataset.embedder ?? location.origin;
  const around = location.ancestorOrigins?.[0] ?? origin; // where missing, postMessage compares origins
  if (parent === window || origin === 'null' || around !== origin) return;
  parent.postMessage({ source: 'keyss', ...event }, origin);
}

interface Source {
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
