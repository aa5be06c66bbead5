// Ways to decode in JavaScript, for Node and pages. An export gives, once it is ready, a function of a file's bytes.

import { decode } from '../../../../../../codec/js/decoder.mjs';

export const plain = async () => decode;
