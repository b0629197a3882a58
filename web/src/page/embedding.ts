/** Embedding in other sites: options in the page's address, and messages to the parent page. */
import { page } from './panel.ts';

const found = new URLSearchParams(location.search);

export const params = {
  file: found.get('file'),
  title: found.get('title'),
  poster: found.get('poster'), // shown until the model is drawn
  autorotate: found.has('autorotate'),
  panel: found.has('key-field') ? 'key' : found.has('noui') ? 'none' : 'all',
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
