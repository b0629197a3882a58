/** The custom element `<keyss-viewer src="model.ply" key-field>`: the page beside this script, in a frame. */
import type { EmbedEvent } from './page/embedding.ts';

const PAGE = new URL('index.html', (document.currentScript as HTMLScriptElement).src);
const STYLE = new CSSStyleSheet();
STYLE.replaceSync(':host { display: block; aspect-ratio: 16 / 9 } iframe { border: 0; width: 100%; height: 100%; display: block }');

class KeyssViewer extends HTMLElement {
  static readonly observedAttributes = ['src', 'title', 'poster', 'autorotate', 'key-field'];
  private readonly frame = document.createElement('iframe');

  constructor() {
    super();
    const root = this.attachShadow({ mode: 'open' });
    root.adoptedStyleSheets = [STYLE];
    this.frame.allow = 'fullscreen';
    root.append(this.frame);
  }

  connectedCallback(): void {
    window.addEventListener('message', this.onMessage);
    this.show();
  }

  disconnectedCallback(): void {
    window.removeEventListener('message', this.onMessage);
  }

  attributeChangedCallback(): void {
    if (this.isConnected) this.show();
  }

  private show(): void {
    const url = new URL(PAGE);
    const [src, title, poster] = ['src', 'title', 'poster'].map((name) => this.getAttribute(name));
    if (src) url.searchParams.set('file', new URL(src, document.baseURI).href);
    if (title) url.searchParams.set('title', title);
    if (poster) url.searchParams.set('poster', new URL(poster, document.baseURI).href);
    if (this.hasAttribute('autorotate')) url.searchParams.set('autorotate', '');
    url.searchParams.set(this.hasAttribute('key-field') ? 'key-field' : 'noui', '');
    this.frame.title = title ?? '3D model';
    if (this.frame.src !== url.href) this.frame.src = url.href;
  }

  /** Dispatches the page's messages as events. */
  private readonly onMessage = ({ source, origin, data }: MessageEvent<EmbedEvent & { source: string }>): void => {
    if (source !== this.frame.contentWindow || origin !== PAGE.origin || data?.source !== 'keyss') return;
    this.dispatchEvent(new CustomEvent(data.event, { detail: data }));
  };
}

customElements.define('keyss-viewer', KeyssViewer);
