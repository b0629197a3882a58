/** The page in a frame of another site: what its address asks for, and what it tells that site. */
import { page } from './panel.ts';

const found = new URLSearchParams(location.search);

/** What the part of the address after `?` says. */
export const asked = {
  file: found.get('file'),
  title: found.get('title'),
  poster: found.get('poster'), // a picture that is shown until there is one of the model
  autorotate: found.has('autorotate'),
  panel: found.has('key-field') ? 'key' : found.has('noui') ? 'none' : 'all',
};

export type Told =
  | { readonly event: 'load'; readonly gaussians: number }
  | { readonly event: 'key-tried' }
  | { readonly event: 'opened'; readonly kind: 'model' | 'file' };

/**
 * Tells the page around this one, if it is of the origin that the publisher named, or of this page's own. A site that
 * puts the page into a frame without being named must not learn whether a visitor's key opened something.
 */
export function tell(told: Told): void {
  const origin = page.main.dataset.embedder ?? location.origin;
  const around = location.ancestorOrigins?.[0] ?? origin; // not in every browser, which then compares by itself
  if (parent === window || origin === 'null' || around !== origin) return;
  parent.postMessage({ source: 'keyss', ...told }, origin);
}
