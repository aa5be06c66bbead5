// SPDX-License-Identifier: Apache-2.0
// Stable radix sort by 8 bits of the key, least significant digit first: count digits, scan the counts, scatter. A
// workgroup takes 4,096 elements in 16 rounds of 256; ranks among equal digits of a round come from bit masks, so that the
// result does not depend on timing.

struct Pass { shift: u32, of_pairs: u32, from_ranks: u32, unused: u32 } // from_ranks: the values are 0, 1, 2, ...

@group(0) @binding(0) var<uniform> radix: Pass;
@group(0) @binding(1) var<storage, read> counters: Counters;
@group(0) @binding(2) var<storage, read> keys_in: array<u32>;
@group(0) @binding(3) var<storage, read> values_in: array<u32>;
@group(0) @binding(4) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> values_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> table: array<u32>; // 256 totals, then for each digit a count per workgroup

const ROUNDS = 16u;
const RUN = 4096u;

var<workgroup> counts: array<atomic<u32>, 256>;

fn element_count() -> u32 {
  return min(select(counters.visible, counters.pairs, radix.of_pairs == 1u), arrayLength(&keys_in));
}

fn run_count() -> u32 { return (element_count() + RUN - 1u) / RUN; }

@compute @workgroup_size(256)
fn count(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
  let n = element_count();
  atomicStore(&counts[lane], 0u);
  workgroupBarrier();
  for (var r = 0u; r < ROUNDS; r++) {
    let i = group.x * RUN + r * 256u + lane;
    if (i < n) { atomicAdd(&counts[(keys_in[i] >> radix.shift) & 255u], 1u); }
  }
  workgroupBarrier();
  table[256u + lane * run_count() + group.x] = atomicLoad(&counts[lane]);
}

// One workgroup per digit.
@compute @workgroup_size(256)
fn scan(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
  let runs = run_count();
  let row = 256u + group.x * runs;
  var carry = 0u;
  for (var first = 0u; first < runs; first += 1024u) {
    var n: array<u32, 4>;
    var sum = 0u;
    let at = first + 4u * lane;
    for (var k = 0u; k < 4u; k++) {
      n[k] = 0u;
      if (at + k < runs) { n[k] = table[row + at + k]; }
      sum += n[k];
    }
    var place = carry + sum_before(lane, sum);
    carry += partial[255];
    for (var k = 0u; k < 4u; k++) {
      if (at + k < runs) { table[row + at + k] = place; }
      place += n[k];
    }
  }
  if (lane == 0u) { table[group.x] = carry; }
}

var<workgroup> masks: array<atomic<u32>, 2048>; // for each digit, 8 words: the lanes of the round with this digit
var<workgroup> places: array<u32, 256>; // of the next element of each digit

@compute @workgroup_size(256)
fn scatter(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
  let n = element_count();
  for (var w = 0u; w < 8u; w++) { atomicStore(&masks[w * 256u + lane], 0u); }
  places[lane] = sum_before(lane, table[lane]) + table[256u + lane * run_count() + group.x];
  workgroupBarrier();
  let word = lane >> 5u;
  let bit = 1u << (lane & 31u);
  for (var r = 0u; r < ROUNDS; r++) {
    let i = group.x * RUN + r * 256u + lane;
    var key = 0u;
    var value = i;
    if (i < n) {
      key = keys_in[i];
      if (radix.from_ranks == 0u) { value = values_in[i]; }
    }
    let digit = (key >> radix.shift) & 255u;
    if (i < n) { atomicOr(&masks[word * 256u + digit], bit); }
    workgroupBarrier();
    if (i < n) {
      var rank = countOneBits(atomicLoad(&masks[word * 256u + digit]) & (bit - 1u));
      for (var w = 0u; w < word; w++) { rank += countOneBits(atomicLoad(&masks[w * 256u + digit])); }
      let at = places[digit] + rank;
      keys_out[at] = key;
      values_out[at] = value;
    }
    workgroupBarrier();
    var taken = 0u;
    for (var w = 0u; w < 8u; w++) { taken += countOneBits(atomicExchange(&masks[w * 256u + lane], 0u)); }
    places[lane] += taken;
    workgroupBarrier();
  }
}
