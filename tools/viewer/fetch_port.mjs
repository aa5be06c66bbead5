// SPDX-License-Identifier: Apache-2.0
// Requests that the worker makes by functions of the page, which cannot be sent to it: `fetch` and `renew` of the engine's options.
// The worker asks through a port of its own for each request; the page answers there.

/**
 * @typedef {import('../../codec/js/decoder.d.ts').FetchOptions} FetchOptions
 * @typedef {{url: string, init: Record<string, any>}} Request
 * @typedef {Parameters<NonNullable<FetchOptions['renew']>>[0]} Refusal
 *
 * What the worker asks for.
 *
 * @typedef {{fetch: Request} | {renew: Refusal}} Question
 *
 * Messages of the page to the worker.
 *
 * @typedef {{status: number, type: ResponseType, headers: [string, string][], hasBody: boolean}
 *   | {bytes: Uint8Array<ArrayBuffer>} | {done: true} | {renewed: any} | {error: string}} Answer
 */

/**
 * Return the fields of a request that can be sent to a worker.
 *
 * @param {RequestInit} [init]
 * @returns {Record<string, any>}
 */
export function sendable({ headers, signal: _signal, window: _window, ...others } = {}) {
  const fields = Object.entries(others).filter(([, value]) => value !== undefined && typeof value !== 'function');
  return { ...Object.fromEntries(fields), ...(headers && { headers: [...new Headers(headers)] }) };
}

/**
 * Return functions for the worker that ask the page.
 *
 * @param {(question: Question, port: MessagePort) => void} ask sends a question and the port of its answers
 * @returns {{fetch: typeof fetch, renew: NonNullable<FetchOptions['renew']>}}
 */
export function pageFunctions(ask) {
  return {
    fetch: (url, { signal, ...init } = {}) => fetchByPage(ask, { url: String(url), init: sendable(init) }, signal),
    renew: (refusal) =>
      new Promise((resolve, reject) => {
        const { port1, port2 } = new MessageChannel();
        port1.onmessage = (/** @type {{data: any}} */ { data }) => {
          port1.close();
          if ('error' in data) reject(new Error(data.error));
          else resolve(data.renewed);
        };
        ask({ renew: refusal }, port2);
      }),
  };
}

/**
 * @param {(question: Question, port: MessagePort) => void} ask
 * @param {Request} request
 * @param {AbortSignal | null} [signal]
 * @returns {Promise<Response>} with the fields that the decoder reads
 */
function fetchByPage(ask, request, signal) {
  const { port1, port2 } = new MessageChannel();
  const cancel = () => {
    port1.postMessage('cancel');
    port1.close();
  };
  return new Promise((resolve, reject) => {
    /** @type {ReadableStreamDefaultController<Uint8Array> | null} */
    let body = null;
    let pulled = () => {};
    const fail = (/** @type {unknown} */ error) => {
      reject(error);
      body?.error(error);
      pulled();
    };
    if (signal?.aborted) return reject(signal.reason);
    signal?.addEventListener('abort', () => (cancel(), fail(signal.reason)), { once: true });
    port1.onmessage = (/** @type {{data: any}} */ { data }) => {
      if ('error' in data) {
        port1.close();
        fail(new TypeError(data.error));
      } else if ('bytes' in data) {
        body?.enqueue(data.bytes);
        pulled();
      } else if ('done' in data) {
        port1.close();
        body?.close();
        pulled();
      } else {
        const stream = new ReadableStream({
          start: (controller) => void (body = controller),
          pull: () => {
            const done = new Promise((/** @type {(value: void) => void} */ next) => (pulled = next));
            port1.postMessage('pull');
            return done;
          },
          cancel,
        });
        const { status, type, headers, hasBody } = data;
        const response = { status, type, headers: new Headers(headers), body: hasBody ? stream : null };
        resolve(/** @type {any} */ (response));
      }
    };
    ask({ fetch: request }, port2);
  });
}

/**
 * Answer a question of the worker.
 *
 * @param {Question} question
 * @param {MessagePort} port
 * @param {FetchOptions} options of the engine
 */
export async function answer(question, port, options) {
  const send = (/** @type {Answer} */ message, /** @type {Transferable[]} */ transfer = []) =>
    port.postMessage(message, transfer);
  try {
    if ('renew' in question) return send({ renewed: sendableAddress(await options.renew?.(question.renew)) });
    await answerFetch(question.fetch, port, send, options.fetch ?? fetch);
  } catch (error) {
    send({ error: String(error instanceof Error ? error.message : error) });
  }
}

/**
 * @param {Request} request
 * @param {MessagePort} port
 * @param {(message: Answer, transfer?: Transferable[]) => void} send
 * @param {typeof fetch} fetch
 */
async function answerFetch({ url, init }, port, send, fetch) {
  const controller = new AbortController();
  const { signal } = controller;
  /** @type {ReadableStreamDefaultReader<Uint8Array> | undefined} */
  let reader;
  const pull = async () => {
    const part = await reader?.read();
    if (!part || part.done) return send({ done: true });
    const bytes = part.value.slice(); // a transfer would take it from others
    send({ bytes }, [bytes.buffer]);
  };
  port.onmessage = ({ data }) => {
    if (data === 'pull') pull().catch((error) => send({ error: String(error) }));
    else {
      controller.abort();
      reader?.cancel().catch(() => {});
      port.close();
    }
  };
  const { status, type, headers, body } = await fetch(url, { ...init, signal });
  reader = body?.getReader();
  if (signal.aborted) reader?.cancel().catch(() => {});
  send({ status, type, headers: [...headers], hasBody: body !== null });
}

/**
 * @param {any} given what the hook returned
 * @returns {any} the same for a message
 */
function sendableAddress(given) {
  if (!given) return null;
  if (typeof given === 'string' || given instanceof URL) return String(given);
  if (!(given instanceof globalThis.Request))
    return { ...sendable(given), ...(given.url && { url: String(given.url) }) };
  const { url, headers, credentials, mode, cache, redirect, referrer, referrerPolicy } = given;
  return sendable(/** @type {any} */ ({ url, headers, credentials, mode, cache, redirect, referrer, referrerPolicy }));
}
