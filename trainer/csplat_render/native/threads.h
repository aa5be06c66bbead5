// SPDX-License-Identifier: Apache-2.0
// Threads that share the items of a pass.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <mutex>
#include <new>
#include <thread>
#include <type_traits>

namespace csplat {

// The threads of the process in addition to the caller's, started as they are needed.
class Threads {
 public:
  // The one object. A forked child calls `forget` first, since it has none of its parent's threads.
  static Threads& shared() { return *instance(); }
  static void forget() { instance() = new Threads; }  // the parent's object is left as it is: it may be locked

  // Calls call(context, item, thread) for all items below `items`, on at most `threads` threads, and waits.
  //
  // If another caller has the threads, this caller works alone, so that no call waits for another.
  void run(int64_t threads, int64_t items, void (*call)(void*, int64_t, int), void* context) {
    std::unique_lock<std::mutex> use(use_, std::defer_lock);
    if (threads > items) threads = items;
    if (threads < 2 || !use.try_lock()) {
      for (int64_t item = 0; item < items; item++) call(context, item, 0);  // which may throw
      return;
    }
    try {
      for (; helpers_ < threads - 1; helpers_++) std::thread([this, number = helpers_ + 1] { serve(number); }).detach();
    } catch (const std::exception&) {
      threads = helpers_ + 1;  // the system gives no more
    }
    std::unique_lock<std::mutex> lock(mutex_);
    call_ = call;
    context_ = context;
    items_ = items;
    next_.store(0, std::memory_order_relaxed);
    used_ = busy_ = threads - 1;
    pass_++;
    lock.unlock();
    begun_.notify_all();
    work(0);
    lock.lock();
    ended_.wait(lock, [this] { return busy_ == 0; });
    if (failed_.exchange(false)) throw std::bad_alloc();
  }

 private:
  static Threads*& instance() {
    static Threads* threads = new Threads;  // never deleted: the threads sleep until the process ends
    return threads;
  }

  void work(int thread) {
    try {
      for (int64_t item; (item = next_.fetch_add(1, std::memory_order_relaxed)) < items_;)
        call_(context_, item, thread);
    } catch (const std::exception&) {
      failed_ = true;
    }
  }

  void serve(int64_t number) {
    int64_t seen = 0;
    std::unique_lock<std::mutex> lock(mutex_);
    while (true) {
      begun_.wait(lock, [this, seen, number] { return pass_ != seen && number <= used_; });
      seen = pass_;
      lock.unlock();
      work(static_cast<int>(number));
      lock.lock();
      if (--busy_ == 0) ended_.notify_one();
    }
  }

  int64_t helpers_ = 0;  // number of started threads
  std::mutex use_, mutex_;
  std::condition_variable begun_, ended_;
  std::atomic<int64_t> next_{0};
  std::atomic<bool> failed_{false};
  void (*call_)(void*, int64_t, int) = nullptr;
  void* context_ = nullptr;
  int64_t items_ = 0, pass_ = 0, busy_ = 0, used_ = 0;
};

// Calls function(item, thread) for all items below `items` on at most `threads` threads, and waits; 0 <= thread <
// threads.
//
// Which thread takes an item is left to chance, so an item must write nothing that another item reads or writes. If the
// function throws, so does this, std::bad_alloc.
template <typename Function>
void parallel(int64_t threads, int64_t items, Function&& function) {
  using Body = std::remove_reference_t<Function>;
  Threads::shared().run(
      threads, items, [](void* body, int64_t item, int thread) { (*static_cast<Body*>(body))(item, thread); },
      const_cast<void*>(static_cast<const void*>(&function)));
}

// Calls function(begin, end, thread) for runs of `run` items.
template <typename Function>
void parallel_runs(int64_t threads, int64_t items, int64_t run, Function&& function) {
  parallel(threads, (items + run - 1) / run, [&](int64_t number, int thread) {
    const int64_t begin = number * run, end = begin + run < items ? begin + run : items;
    function(begin, end, thread);
  });
}

}  // namespace csplat
