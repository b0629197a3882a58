/** Where the page has its model from: within itself, beside it, or in its address. */

export interface Source {
  readonly name: string;
  readonly bytes: () => Promise<Uint8Array>;
}

/** Null where there is none. */
export function givenModel(): Source | null {
  const inside = document.getElementById('model');
  const beside = document.querySelector<HTMLMetaElement>('meta[name="keyss-model"]')?.content;
  const asked = new URLSearchParams(location.search).get('file');
  if (inside?.textContent) {
    const text = inside.textContent;
    inside.remove(); // the text is not needed twice
    return { name: inside.dataset.name ?? 'model', bytes: async () => bytesOfBase64(text) };
  }
  const address = asked ?? beside;
  if (!address) return null;
  const url = new URL(address, document.baseURI);
  const named = url.pathname.split('/').pop()!.replaceAll('+', '%2B');
  return { name: new URLSearchParams(`name=${named}`).get('name') || 'model', bytes: () => fetched(url) };
}

/** Raises an error for what is not there, or on another host. */
export async function fetched(url: URL | string): Promise<Uint8Array> {
  const response = await fetch(url, { credentials: 'omit' });
  if (!response.ok) throw new Error(String(response.status));
  return new Uint8Array(await response.arrayBuffer());
}

function bytesOfBase64(text: string): Uint8Array {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let at = 0; at < binary.length; at++) bytes[at] = binary.charCodeAt(at);
  return bytes;
}
