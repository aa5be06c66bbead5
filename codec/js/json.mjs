// SPDX-License-Identifier: Apache-2.0
// A strict JSON parser (spec 5.4, JSN-1). JSON.parse is too lenient: it keeps the last of two equal names, turns large
// numbers into Infinity, accepts lone surrogates and recurses without a limit.

import { JSON_DEPTH_MAX } from './spec.mjs';

const NUMBER = /-?(?:0|[1-9][0-9]*)(?:\.[0-9]+)?(?:[eE][+-]?[0-9]+)?/y;
const PLAIN = /[^"\\\u0000-\u001f]*/y;
const SPACE = /[ \t\n\r]*/y;
const SURROGATE = /\p{Surrogate}/u; // with the flag u, matches only unpaired surrogates
/** @type {Record<string, string>} */
const ESCAPES = { '"': '"', '\\': '\\', '/': '/', b: '\b', f: '\f', n: '\n', r: '\r', t: '\t' };
/** @type {[string, unknown][]} */
const WORDS = [
  ['true', true],
  ['false', false],
  ['null', null],
];

/**
 * Parse a JSON text.
 *
 * @param {Uint8Array} bytes UTF-8
 * @returns {unknown}
 * @throws {SyntaxError} names what violates JSN-1; the caller knows the offset in the file
 */
export function parseJson(bytes) {
  let text;
  try {
    text = new TextDecoder('utf-8', { fatal: true, ignoreBOM: true }).decode(bytes);
  } catch {
    throw new SyntaxError('not UTF-8');
  }
  return new Parser(text).parse();
}

class Parser {
  /** @param {string} text */
  constructor(text) {
    this.text = text;
    this.at = 0;
    this.depth = 0;
  }

  parse() {
    const value = this.value();
    if (this.at !== this.text.length) throw this.error('something after the value');
    return value;
  }

  /** @param {string} what */
  error(what) {
    return new SyntaxError(`${what} at character ${this.at}`);
  }

  /** @param {RegExp} pattern sticky */
  match(pattern) {
    pattern.lastIndex = this.at;
    const found = pattern.exec(this.text)?.[0] ?? '';
    this.at += found.length;
    return found;
  }

  /** @param {string} character */
  accept(character) {
    if (this.text[this.at] !== character) return false;
    this.at++;
    return true;
  }

  /** Parse a value and the white space around it. @returns {unknown} */
  value() {
    this.match(SPACE);
    const value = this.bareValue();
    this.match(SPACE);
    return value;
  }

  /** @returns {unknown} */
  bareValue() {
    if (this.accept('{')) return this.nested(() => this.object());
    if (this.accept('[')) return this.nested(() => this.array());
    if (this.accept('"')) return this.string();
    for (const [word, value] of WORDS) {
      if (this.text.startsWith(word, this.at)) {
        this.at += word.length;
        return value;
      }
    }
    return this.number();
  }

  /** @param {() => unknown} read */
  nested(read) {
    if (++this.depth > JSON_DEPTH_MAX) throw this.error(`more than ${JSON_DEPTH_MAX} arrays and objects open`);
    const value = read();
    this.depth--;
    return value;
  }

  object() {
    /** @type {Record<string, unknown>} */
    const object = {};
    this.match(SPACE);
    if (this.accept('}')) return object;
    do {
      this.match(SPACE);
      if (!this.accept('"')) throw this.error('no name');
      const name = this.string();
      if (Object.hasOwn(object, name)) throw this.error(`the name ${JSON.stringify(name)} twice`);
      this.match(SPACE);
      if (!this.accept(':')) throw this.error('no colon');
      // defineProperty, since the name may be __proto__.
      Object.defineProperty(object, name, {
        value: this.value(),
        writable: true,
        enumerable: true,
        configurable: true,
      });
    } while (this.accept(','));
    if (!this.accept('}')) throw this.error('an object without end');
    return object;
  }

  array() {
    /** @type {unknown[]} */
    const array = [];
    this.match(SPACE);
    if (this.accept(']')) return array;
    do array.push(this.value());
    while (this.accept(','));
    if (!this.accept(']')) throw this.error('an array without end');
    return array;
  }

  string() {
    let string = this.match(PLAIN);
    let escaped = false;
    while (this.accept('\\')) {
      escaped = true;
      string += this.escape() + this.match(PLAIN);
    }
    if (!this.accept('"')) throw this.error('a string without end, or a control character in it');
    if (escaped && SURROGATE.test(string)) throw this.error('half of a surrogate pair');
    return string;
  }

  escape() {
    const letter = this.text[this.at++] ?? '';
    if (letter === 'u') {
      const digits = this.text.slice(this.at, this.at + 4);
      if (!/^[0-9a-fA-F]{4}$/.test(digits)) throw this.error('\\u without four digits');
      this.at += 4;
      return String.fromCharCode(parseInt(digits, 16));
    }
    const character = Object.hasOwn(ESCAPES, letter) ? ESCAPES[letter] : undefined;
    if (character === undefined) throw this.error('an escape that JSON does not have');
    return character;
  }

  number() {
    const digits = this.match(NUMBER);
    if (digits === '') throw this.error('no value');
    const value = Number(digits);
    if (!Number.isFinite(value)) throw this.error('a number beyond binary64');
    return value;
  }
}
