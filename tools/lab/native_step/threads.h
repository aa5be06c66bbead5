// Threads that share the items of a pass.
#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <thread>
#include <type_traits>
#include <vector>

namespace csplat {

// Runs a function for every item of a pass on a fixed number of threads, the caller's among them.
//
// Which thread takes an item is left to chance, so an item must write nothing that another item reads or writes.
class Threads {
 public:
  explicit Threads(int count) {
    for (int thread = 1; thread < count; thread++) helpers_.emplace_back([this, thread] { serve(thread); });
  }
  ~Threads() {
    std::unique_lock<std::mutex> lock(mutex_);
    pass_ = -1;
    lock.unlock();
    begun_.notify_all();
    for (std::thread& helper : helpers_) helper.join();
  }

  // Calls function(item, thread) for all items below `items`, and waits.
  template <typename Function>
  void run(int64_t items, Function&& function) {
    if (helpers_.empty() || items < 2) {
      for (int64_t item = 0; item < items; item++) function(item, 0);
      return;
    }
    std::unique_lock<std::mutex> lock(mutex_);
    call_ = [](void* context, int64_t item, int thread) {
      (*static_cast<std::remove_reference_t<Function>*>(context))(item, thread);
    };
    context_ = const_cast<void*>(static_cast<const void*>(&function));
    items_ = items;
    next_.store(0, std::memory_order_relaxed);
    busy_ = static_cast<int>(helpers_.size());
    pass_++;
    lock.unlock();
    begun_.notify_all();
    work(0);
    lock.lock();
    ended_.wait(lock, [this] { return busy_ == 0; });
  }

 private:
  void work(int thread) {
    for (int64_t item; (item = next_.fetch_add(1, std::memory_order_relaxed)) < items_;) call_(context_, item, thread);
  }

  void serve(int thread) {
    int64_t seen = 0;
    std::unique_lock<std::mutex> lock(mutex_);
    while (true) {
      begun_.wait(lock, [this, seen] { return pass_ != seen; });
      if (pass_ < 0) return;
      seen = pass_;
      lock.unlock();
      work(thread);
      lock.lock();
      if (--busy_ == 0) ended_.notify_one();
    }
  }

  std::vector<std::thread> helpers_;
  std::mutex mutex_;
  std::condition_variable begun_, ended_;
  std::atomic<int64_t> next_{0};
  void (*call_)(void*, int64_t, int) = nullptr;
  void* context_ = nullptr;
  int64_t items_ = 0, pass_ = 0;
  int busy_ = 0;
};

}  // namespace csplat
