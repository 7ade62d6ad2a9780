//! Tasks of different lengths that run in parallel, and the buffers of the threads that run them.

use std::cmp::Reverse;
use std::sync::{Mutex, MutexGuard};

/// A buffer for every thread: what is there stays in its core's cache.
pub struct PerThread<T>(Vec<Mutex<T>>);

impl<T: Default> Default for PerThread<T> {
    fn default() -> Self {
        Self((0..rayon::current_num_threads()).map(|_| Mutex::default()).collect())
    }
}

impl<T: Default> PerThread<T> {
    /// The buffer of the thread that asks, for which nobody else does unless there are more threads than at the beginning.
    pub fn mine(&self) -> MutexGuard<'_, T> {
        let mutex = &self.0[rayon::current_thread_index().unwrap_or_default() % self.0.len()];
        mutex.lock().unwrap_or_else(|poisoned| {
            // What a panic has left there is nobody's.
            let mut mine = poisoned.into_inner();
            *mine = T::default();
            mutex.clear_poison();
            mine
        })
    }
}

/// Tasks that do not wait for one another, each with what it costs beside the others.
#[derive(Default)]
pub struct Tasks<'a>(Vec<(usize, Box<dyn FnOnce() + Send + 'a>)>);

impl<'a> Tasks<'a> {
    /// Adds a task; `cost` in any unit that all of them share.
    pub fn add(&mut self, cost: usize, task: impl FnOnce() + Send + 'a) {
        self.0.push((cost, Box::new(task)));
    }

    /// Runs all of them, those that take longest first: so no thread is left alone with a long one.
    pub fn run(mut self) {
        self.0.sort_by_key(|(cost, _)| Reverse(*cost));
        rayon::scope_fifo(|scope| {
            for (_, task) in self.0 {
                scope.spawn_fifo(move |_| task());
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_panic_has_left_is_thrown_away() {
        let buffers = PerThread::<Vec<u32>>::default();
        let panics = std::panic::AssertUnwindSafe(|| {
            buffers.mine().push(1);
            let _mine = buffers.mine();
            panic!("with a buffer in hand");
        });
        assert!(std::panic::catch_unwind(panics).is_err());
        assert!(buffers.mine().is_empty());
        buffers.mine().push(2);
        assert_eq!(*buffers.mine(), [2]);
    }

    #[test]
    fn the_longest_runs_first() {
        let order = Mutex::new(Vec::new());
        let mut tasks = Tasks::default();
        for cost in [3, 1, 4, 1, 5, 9, 2, 6] {
            let order = &order;
            tasks.add(cost, move || order.lock().expect("no task panics").push(cost));
        }
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread can be started");
        pool.install(|| tasks.run());
        assert_eq!(order.into_inner().expect("no task panics"), [9, 6, 5, 4, 3, 2, 1, 1]);
    }
}
