// SPDX-License-Identifier: Apache-2.0
// Generates mutants of JavaScript modules: one changed operator, constant, bound or statement each (csplat_selftest.mutation).
//
//   node operators.mjs .../typescript/lib/typescript.js a.mjs b.mjs    # one line of JSON: [[file, line, start, old, new], ...]

import { readFileSync } from 'node:fs';
import { basename } from 'node:path';
import { pathToFileURL } from 'node:url';

const [library, ...files] = process.argv.slice(2);
const { default: ts } = await import(pathToFileURL(library).href);
const { SyntaxKind: Kind } = ts;

/** Replacements of operators. @type {Record<string, string[]>} */
const BINARY = {
  '<': ['<=', '>='],
  '<=': ['<', '>'],
  '>': ['>=', '<='],
  '>=': ['>', '<'],
  '===': ['!=='],
  '!==': ['===', '<', '>'], // only one side of a mismatch
  '==': ['!='],
  '!=': ['==', '<', '>'],
  '&&': ['||'],
  '||': ['&&'],
  '??': ['&&'],
  '+': ['-'],
  '-': ['+'],
  '*': ['/'],
  '/': ['*'],
  '%': ['*'],
  '<<': ['>>'],
  '>>': ['<<'],
  '>>>': ['<<'],
  '&': ['|'],
  '|': ['&'],
  '^': ['&'],
  '+=': ['-='],
  '-=': ['+='],
  '*=': ['/='],
  '/=': ['*='],
  '<<=': ['>>='],
  '>>=': ['<<='],
  '>>>=': ['<<='],
  '&=': ['|='],
  '|=': ['&='],
  '^=': ['&='],
};
/** @type {Record<string, string>} */
const METHODS = { min: 'max', max: 'min', some: 'every', every: 'some' };
const SLICES = ['slice', 'subarray'];
const mutants = [];

for (const file of files) {
  const text = readFileSync(file, 'utf8');
  const source = ts.createSourceFile(file, text, ts.ScriptTarget.Latest, true, ts.ScriptKind.JS);
  inside(source);

  function inside(node) {
    of(node);
    // Mutants drop a throw statement as a whole; its message, like templates and imports, is not mutated.
    if (ts.isThrowStatement(node) || ts.isTemplateExpression(node) || ts.isImportDeclaration(node)) return;
    ts.forEachChild(node, inside);
  }

  function replaced(node, changed) {
    const start = node.getStart(source);
    const line = source.getLineAndCharacterOfPosition(start).line + 1;
    mutants.push([basename(file), line, start, text.slice(start, node.end), changed]);
  }

  /** Add the mutants of this node, without its children. */
  function of(node) {
    if (ts.isBinaryExpression(node)) {
      const { left, operatorToken: operator, right } = node;
      for (const other of BINARY[operator.getText(source)] ?? []) {
        const changed = `${left.getText(source)} ${other} ${right.getText(source)}`;
        replaced(
          node,
          other.length > 1 && other.endsWith('=') && !'<>=!'.includes(other[0]) ? changed : `(${changed})`,
        );
      }
    } else if (ts.isPrefixUnaryExpression(node) && node.operator === Kind.ExclamationToken) {
      replaced(node, `(${node.operand.getText(source)})`);
    } else if (ts.isNumericLiteral(node) || ts.isBigIntLiteral(node)) {
      const one = ts.isBigIntLiteral(node) ? '1n' : '1';
      if (!ts.isPropertyAssignment(node.parent) || node.parent.name !== node) {
        replaced(node, `(${node.getText(source)} + ${one})`);
        replaced(node, `(${node.getText(source)} - ${one})`);
      }
    } else if (node.kind === Kind.TrueKeyword) replaced(node, 'false');
    else if (node.kind === Kind.FalseKeyword) replaced(node, 'true');
    else if (ts.isCallExpression(node)) call(node);
    else if (ts.isThrowStatement(node)) replaced(node, ';');
    else if (ts.isExpressionStatement(node)) {
      const inner = ts.isAwaitExpression(node.expression) ? node.expression.expression : node.expression;
      if (ts.isCallExpression(inner)) replaced(node, ';');
    } else if (ts.isReturnStatement(node) && !isLast(node)) replaced(node, ';');
  }

  function call(node) {
    if (!ts.isPropertyAccessExpression(node.expression)) return;
    const { expression: object, name } = node.expression;
    const other = METHODS[name.text];
    if (other !== undefined) replaced(node.expression, `${object.getText(source)}.${other}`);
    if (!SLICES.includes(name.text)) return;
    for (const bound of node.arguments) {
      if (ts.isNumericLiteral(bound)) continue; // mutated as a constant
      for (const sign of ['+', '-']) replaced(bound, `(${bound.getText(source)}) ${sign} 1`);
    }
  }
}

/** Return true if the statement is the last of a function, whose return value no caller uses. */
function isLast(node) {
  const block = node.parent;
  return ts.isBlock(block) && block.statements.at(-1) === node && ts.isFunctionLike(block.parent);
}

console.log(JSON.stringify(mutants));
