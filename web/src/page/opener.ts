/** The worker that reads files and tries keys, as functions. */
import WORKER from 'source:../worker.ts';
import { started } from '../keys/pool.ts';
import type { Answer, Question } from '../protocol.ts';

export class Opener {
  private readonly worker: Worker;
  private readonly waiting = new Map<number, (answer: Answer) => void>();
  private next = 0;

  /** `onProgress` gets the share of an attempt that is done, 0 to 1, at the same times for every key. */
  constructor(private readonly onProgress: (share: number) => void) {
    this.worker = started(WORKER);
    this.worker.onmessage = ({ data }: MessageEvent<Answer>) => {
      if (data.progress !== undefined) return this.onProgress(data.progress);
      this.waiting.get(data.id)?.(data);
      this.waiting.delete(data.id);
    };
    this.worker.onerror = () => {
      for (const [id, resolve] of this.waiting) resolve({ id, error: 'This file cannot be read.' });
      this.waiting.clear();
    };
  }

  /** The model in a file; unless it is `keyless`, keys are tried on it from now on. */
  load(bytes: Uint8Array, name: string, keyless = false): Promise<Answer> {
    return this.ask({ id: this.next++, bytes, name, keyless }, [bytes.buffer as ArrayBuffer]);
  }

  /** What a key opens; in colours, too, where these are to be looked through. */
  unlock(key: string, colours: boolean): Promise<Answer> {
    return this.ask({ id: this.next++, key, colours });
  }

  private ask(question: Question, moved: Transferable[] = []): Promise<Answer> {
    return new Promise((resolve) => {
      this.waiting.set(question.id, resolve);
      this.worker.postMessage(question, moved);
    });
  }
}
