// SPDX-License-Identifier: Apache-2.0
// Exclusive sums over a workgroup of 256, which never exceed SATURATED.

const SATURATED = 0x7fffffu << 4u; // 2^27 - 16: more than any buffer holds; the sum of two is exact

var<workgroup> partial: array<u32, 256>;

fn saturating(a: u32, b: u32) -> u32 { return min(a + b, SATURATED); }

// The sum of the lanes before; afterwards, partial[255] is the sum of all.
fn sum_before(lane: u32, value: u32) -> u32 {
  workgroupBarrier();
  partial[lane] = value;
  workgroupBarrier();
  for (var reach = 1u; reach < 256u; reach <<= 1u) {
    var before = 0u;
    if (lane >= reach) { before = partial[lane - reach]; }
    workgroupBarrier();
    partial[lane] = saturating(partial[lane], before);
    workgroupBarrier();
  }
  return select(partial[max(lane, 1u) - 1u], 0u, lane == 0u);
}
