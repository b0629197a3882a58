/** The workers that read files and try keys, as functions. */
import DERIVE from 'source:../derive.ts';
import WORKER from 'source:../worker.ts';
import type { Answer, Question } from '../protocol.ts';

export class Opener {
  private readonly worker: Worker;
  private readonly waiting = new Map<number, (answer: Answer) => void>();
  private next = 0;

  constructor() {
    this.worker = started(WORKER);
    const { port1, port2 } = new MessageChannel();
    started(DERIVE).postMessage(null, [port1]);
    this.worker.postMessage({ id: this.next++, port: port2 }, [port2]);
    this.worker.onmessage = ({ data }: MessageEvent<Answer>) => {
      this.waiting.get(data.id)?.(data);
      this.waiting.delete(data.id);
    };
    this.worker.onerror = () => {
      for (const [id, resolve] of this.waiting) resolve({ id, error: 'This file cannot be read.' });
      this.waiting.clear();
    };
  }

  /** The model in a file; keys are tried on it from now on. */
  load(bytes: Uint8Array, name: string): Promise<Answer> {
    return this.ask({ id: this.next++, bytes, name }, [bytes.buffer as ArrayBuffer]);
  }

  /** What a key opens. */
  unlock(key: string): Promise<Answer> {
    return this.ask({ id: this.next++, key });
  }

  private ask(question: Question, moved: Transferable[] = []): Promise<Answer> {
    return new Promise((resolve) => {
      this.waiting.set(question.id, resolve);
      this.worker.postMessage(question, moved);
    });
  }
}

/** A worker from a blob, so that a page that is one file and opens from disk has one, too. */
function started(source: string): Worker {
  return new Worker(URL.createObjectURL(new Blob([source], { type: 'text/javascript' })));
}
